"""Pictures of shells, modes and curves."""
