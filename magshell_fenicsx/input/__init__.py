"""Foundations of every section of a case: its base with units, messages with file, line and key,
formulas.
"""
