"""Versions, ranks, terminal: what differs between machines."""
