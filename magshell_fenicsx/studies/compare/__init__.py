"""Comparison of the shell and the solid model of a case."""
