"""Meshes that reach a tolerance."""
