"""What is said of the configuration files, made from the tables that read them: schema, keys, page."""
