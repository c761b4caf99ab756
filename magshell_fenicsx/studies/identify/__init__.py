"""Identification: parameters of a case from measured data, and predictions with bands."""
