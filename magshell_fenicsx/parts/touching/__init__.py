"""Shells that touch each other or themselves."""
