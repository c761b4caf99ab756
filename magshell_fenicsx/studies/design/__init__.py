"""Designs: what varies, what is wanted, an optimiser, and the best case as a file."""
