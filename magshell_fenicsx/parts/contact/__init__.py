"""Contact of shells with each other and with themselves."""
