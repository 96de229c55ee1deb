"""The log: record layout and schema, shared-memory ring, MCAP writer process, tolerant reader."""
