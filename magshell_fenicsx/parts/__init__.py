"""The abilities, each in a package of its own, and the base of their sections and steps."""
