"""Forces, dead loads and moments."""
