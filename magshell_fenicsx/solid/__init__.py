"""The three-dimensional judge: the same body as a hard-magnetic solid, with the shell's own solvers."""
