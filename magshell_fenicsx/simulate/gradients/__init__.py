"""Gradients of results: an adjoint, and what it contracts."""
