"""Boundaries of stability: an instability that is followed in a second key of the case."""
