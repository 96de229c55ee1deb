"""CAN: bus, codec and drive client. The only package that knows CAN; imports neither hil nor firmware_model."""
