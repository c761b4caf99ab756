"""Comparisons of a case as a shell and as a solid."""
