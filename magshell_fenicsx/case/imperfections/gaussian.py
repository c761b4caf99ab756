"""A Gaussian dimple."""

from math import exp, sqrt
from typing import Literal

from magshell_fenicsx.case.imperfections.dimple import refuse_steep
from magshell_fenicsx.parts.imperfections.place import LocalSection


class GaussianSection(LocalSection):
    """w0 = -δ exp(-(φ/φg)²) around a place, with the distance φ of a dimple; smooth everywhere."""

    kind: Literal["gaussian"]

    def account(self) -> str:
        return f"Gaussian dimple of {self.amplitude:g} h {self.at.words()}"

    def refuse_unfit(self, R_over_h: float, nu: float) -> None:
        depth = abs(self.amplitude) / R_over_h
        refuse_steep(depth, sqrt(2) * exp(-0.5) * depth / self.half_width(R_over_h, nu))
