"""Ogden's fit to Treloar's rubber (Proc.

R. Soc. Lond. A 326, 1972): mu in MPa, as it is printed, and over E.
"""

MU, ALPHA = (0.63, 0.0012, -0.01), (1.3, 5.0, -2.0)
TRELOAR = tuple(mu / (1.5 * sum(m * a for m, a in zip(MU, ALPHA, strict=True))) for mu in MU), ALPHA
