"""The fault matrix: scripted faults against the running loop, each judged from what was logged."""
