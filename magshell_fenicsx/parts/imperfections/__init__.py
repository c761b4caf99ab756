"""Deviations of the mid-surface from its perfect shape: one file for each kind."""
