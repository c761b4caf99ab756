"""What a case is made of: the base of all sections, and parts that bring an energy with all that belongs to it."""
