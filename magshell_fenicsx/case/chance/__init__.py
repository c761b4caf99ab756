"""Random quantities of a case file: distributions of numbers, and random places."""
