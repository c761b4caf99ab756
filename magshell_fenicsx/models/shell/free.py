"""Parameters that enter the densities of surface energies freely, as amplitudes of their own."""

import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.own_term import Free, OwnTerm

Constants = dict[str, fem.Constant]


def constants_of(term: OwnTerm, domain: mesh.Mesh, known: Constants) -> tuple[fem.Constant, ...]:
    """The parameters of a term as constants; a free one has the same constant in all terms, kept in `known`."""

    def constant(value: float | NDArray[np.float64]) -> fem.Constant:
        return fem.Constant(domain, np.asarray(value, dtype=float))

    return tuple(
        known.setdefault(p.name, constant(p.value)) if isinstance(p, Free) else constant(p) for p in term.parameters
    )
