"""Versions, ranks, terminal: everything that differs between machines."""
