"""The base of parts: sections of a case that add energies."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import register


@dataclass(frozen=True)
class Scales:
    """The scales of a case: R, h and E in its units; 1, h/R and 1 for a case without lengths."""

    R: float
    h: float
    E: float
    nu: float

    @property
    def force(self) -> float:
        """2πD/R over E h R."""
        return float(np.pi * (self.h / self.R) ** 2 / (6 * (1 - self.nu**2)))


class Part(Section):
    """A section of the case file whose energies are integrals over the mid-surface.

    A subclass needs one file and one line in `registered.py`. Its docstring and those of its keys appear in
    docs/case.md. `OwnTerm` finds the arguments, the symmetry and the derivatives of its densities, so a part works in
    every model.

    Attributes
    ----------
    quantities
        The columns that it adds to path.csv: the amplitude of each term under its name, and the observed integrals.
    absent
        The line of `magshell check` for a case without the part.
    """

    quantities: ClassVar[tuple[Quantity, ...]]
    absent: ClassVar[str]

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        register(cls.quantities)

    def terms(self, scales: Scales) -> Sequence[OwnTerm]:
        """The energies, with the values of their amplitudes."""
        raise NotImplementedError

    def account(self, scales: Scales) -> str:
        """The line of `magshell check` for a case with the part."""
        raise NotImplementedError
