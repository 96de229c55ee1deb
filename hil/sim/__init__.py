"""Without a real drive: the emulator's process, the compiled simulation, and the demo."""
