"""What a run leaves: tables and checkpoints, fields, pictures, a report."""
