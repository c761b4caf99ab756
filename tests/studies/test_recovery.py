"""A remanence is found again from the shape that it gives."""
