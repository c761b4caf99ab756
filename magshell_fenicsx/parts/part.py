"""A part of a case that brings its own energies."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.section import Section
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import register


@dataclass(frozen=True)
class Scales:
    """What the numbers of a case are over: R, h and E in the case's units, of a case without lengths 1, h/R and 1."""

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

    A subclass is one file and one line of `registered.py`. Its docstring and those of its keys are its lines in
    docs/case.md. What its densities depend on, the symmetry that they leave and their derivatives are found from
    them, see `OwnTerm`; so a part is there in every model.

    Attributes
    ----------
    quantities
        The columns that it adds to path.csv: one with the name of each term, its amplitude, and what terms observe.
    absent
        What `magshell check` lists as left out where a case does not have the part.
    """

    quantities: ClassVar[tuple[Quantity, ...]]
    absent: ClassVar[str]

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        register(cls.quantities)

    def terms(self, scales: Scales) -> Sequence[OwnTerm]:
        """Its energies, with the values of their amplitudes."""
        raise NotImplementedError

    def account(self, scales: Scales) -> str:
        """What `magshell check` lists as built."""
        raise NotImplementedError
