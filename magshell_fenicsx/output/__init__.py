"""The output of a run: tables and checkpoints, fields, pictures, a report."""
