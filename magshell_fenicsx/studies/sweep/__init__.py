"""Sweeps: a case over ranges of its keys."""
