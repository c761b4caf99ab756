"""The parts added up, without any mesh: symmetry, sizes, names, limits, columns, check."""
