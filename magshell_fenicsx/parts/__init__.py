"""The abilities, each in a room of its own, and the base of their sections and steps."""
