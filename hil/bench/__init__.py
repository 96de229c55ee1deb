"""`hil bench`: what a tick costs, how fast and how punctual the loop is on this machine, beside its floor.

Everything is measured on real `hil run` and `hil emulate` processes and read from the logs they wrote; the
bare loop and cyclictest run in the same minute, so that the figures can be set in proportion.
"""
