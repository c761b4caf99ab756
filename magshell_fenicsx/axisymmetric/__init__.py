"""Axisymmetric scenes on their meridian, and the circumferential waves that it excludes."""
