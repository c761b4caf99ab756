"""A free parameter of terms: the derivatives of their energies with respect to it."""

from collections.abc import Mapping
from dataclasses import dataclass

from dolfinx import fem

from magshell_fenicsx.assembly.terms import Term


@dataclass(frozen=True)
class Parameter:
    """A free parameter p of a system with the terms mu_i Pi_i(u; p), in which p is a constant.

    Attributes
    ----------
    constant
        p in the terms.
    slopes
        Amplitude mu_i -> dPi_i/dp, as a term.
    bends
        Parameter q -> amplitude mu_i -> d2Pi_i/dp dq, as a form; q may be p.
    """

    constant: fem.Constant
    slopes: Mapping[str, Term]
    bends: Mapping[str, Mapping[str, fem.Form]]
