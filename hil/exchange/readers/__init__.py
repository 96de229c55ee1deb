"""Readers of other tools' recordings, a module a format: frames with their kind, and what can't be read."""
