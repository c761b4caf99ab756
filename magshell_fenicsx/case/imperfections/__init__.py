"""The imperfections of a mid-surface: one file for each kind, registered in `registered.py`."""
