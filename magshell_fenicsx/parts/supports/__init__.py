"""What is held, what moves there, and its reactions."""
