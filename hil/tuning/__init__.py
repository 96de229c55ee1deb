"""Tuning of the drive laws: a linear closed loop, an optimiser, a comparison of laws, a design of windows."""
