"""Files that survive an interruption: tables, checkpoints, the folder of results."""
