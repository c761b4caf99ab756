"""Parameters that enter the densities of surface energies freely, as amplitudes of their own."""

import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray
from ufl import Coefficient

from magshell_fenicsx.mesh.patch import GivenField, MeshError
from magshell_fenicsx.models.shell.own_term import Free, OwnTerm

Constants = dict[str, fem.Constant]


def constants_of(term: OwnTerm, domain: mesh.Mesh, known: Constants) -> tuple[fem.Constant | fem.Function, ...]:
    """The parameters of a term as constants; a free one has the same constant in all terms, kept in `known`.

    Raises
    ------
    MeshError
        If one is a function on another mesh.
    """

    def constant(value: float | NDArray[np.float64]) -> fem.Constant:
        return fem.Constant(domain, np.asarray(value, dtype=float))

    def made(p: float | NDArray[np.float64] | Free | GivenField | Coefficient) -> fem.Constant | fem.Function:
        if isinstance(p, Free):
            return known.setdefault(p.name, constant(p.value))
        if isinstance(p, Coefficient) and p.ufl_function_space().ufl_domain() == domain.ufl_domain():
            return p
        if isinstance(p, Coefficient | GivenField):
            raise MeshError(
                f"terms: {term.name}: a function on a mesh: that is of a problem whose shell is on this mesh, "
                "see ms.Shell"
            )
        return constant(p)

    return tuple(made(p) for p in term.parameters)
