"""What the parts of a case contribute to: the shell, its meridian, the solid."""
