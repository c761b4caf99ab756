"""Mass, viscosity and steps in time."""
