"""The sections of a case: their base class, and parts that add an energy to the model."""
