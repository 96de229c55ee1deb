"""Hardware-in-the-loop CAN drive controller with a fixed-time disturbance observer."""
