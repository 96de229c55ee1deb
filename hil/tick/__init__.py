"""What one tick decides: guard, supervisor, set-point and law in one compiled step, and why runs end."""
