"""Outlines of mid-surfaces, their mirrors, and what is axisymmetric on them."""
