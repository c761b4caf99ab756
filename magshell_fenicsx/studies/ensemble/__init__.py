"""Random samples of a case, and their statistics."""
