"""Designs: a case that an optimiser varies for a result."""
