"""Files that survive an interruption."""
