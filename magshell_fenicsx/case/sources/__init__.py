"""The sources of the applied field: one section for each kind."""
