"""Logs in the formats of other tools: tables of ticks, recordings of frames."""
