"""Sources of the applied field: one file for each kind."""
