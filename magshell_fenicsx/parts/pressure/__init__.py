"""Live pressure, enclosed gas, and the lids of openings."""
