"""What ``hil.__all__`` names: each function is a command of ``hil`` for notebooks and scripts."""
