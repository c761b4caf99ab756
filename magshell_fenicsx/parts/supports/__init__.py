"""Supports: conditions on edges and points, their motions, and their reactions."""
