"""What every section of a case is made of: its base with units, messages with file, line and key,
formulas.
"""
