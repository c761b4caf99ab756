"""Sources as fields in space: from each kind's section to a function of places."""
