"""The quantities of a run: names, symbols, units and meanings, defined once for all outputs."""
