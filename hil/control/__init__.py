"""Pure control maths: one implementation for bus, replay and simulation. Imports nothing of hil."""
