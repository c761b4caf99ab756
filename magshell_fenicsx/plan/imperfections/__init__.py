"""From the imperfections of a case to what must be built: one file for each kind, registered in `registered.py`."""
