"""The shell's body as a three-dimensional hard-magnetic solid, which judges the shell."""
