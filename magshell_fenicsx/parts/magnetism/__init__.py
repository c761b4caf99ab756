"""Remanence, applied field and its sources, and the energies of both."""
