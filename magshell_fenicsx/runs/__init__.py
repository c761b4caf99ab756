"""A run and its folder: rows, status line, interruption, summary."""
