"""Mechanics of shells, of their meridians and of solids, to which the parts of a case
contribute.
"""
