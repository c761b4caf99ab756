"""The Koiter shell with its magnetic energy on a surface mesh: C0 interior penalty for bending."""
