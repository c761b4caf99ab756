"""A case as a scene that can be followed, traced and differentiated."""
