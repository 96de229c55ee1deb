"""A run's configuration: tables, loading, limits against frames, and the records designed from it."""
