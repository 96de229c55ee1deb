"""Before arming: what can be known of host, bus, drive and filter, as rows of pass, warn or fail."""
