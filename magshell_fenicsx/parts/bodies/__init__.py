"""Rigid bodies that press on the shell, or stand in its way."""
