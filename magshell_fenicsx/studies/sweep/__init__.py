"""A case over ranges of its keys."""
