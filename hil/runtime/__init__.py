"""The running loop: set-up, bus, clock, guardian, arming, and the tick as one compiled call."""
