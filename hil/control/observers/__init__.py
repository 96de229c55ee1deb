"""Disturbance observers, one file each: keys, design, and the formulas of noise and lag."""
