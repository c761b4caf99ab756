"""What varies and what is observed: names, symbols, units and meanings, one source for all that shows them."""
