"""Studies of error against run time, over meshes, degrees, models and ranks."""
