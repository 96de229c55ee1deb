"""The emulated drive: motor, inverter, sensors, load and firmware. Never imports hil or the drive client."""
