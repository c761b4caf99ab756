"""Ensembles: random samples of a case and their statistics."""
