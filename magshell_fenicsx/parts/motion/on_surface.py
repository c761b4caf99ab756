"""What viscous forces need to know of a shell."""

from collections.abc import Iterator

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.shape_tables import Table
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.energy import ShellTerm
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.parts.motion.viscous import SIZE, Edge, Surface, held_jump, mirrored_jump


def surface_of(model: ShellModel) -> Surface:
    """Strains are known at the nodes of each cell."""
    V, factory, carrier = model.V, model.factory, model.factory.carrier
    element, nodes = V.element.basix_element, V.dofmap.list
    table, r0, m = Table.tabulate(element, element.points), carrier.j0, carrier.covector
    return Surface(
        fem.functionspace(V.mesh, ("DG", model.degree, (SIZE,))),
        lambda nodal: np.asarray(np.moveaxis(table.jets(nodal.reshape(-1, 3)[nodes]), 2, 0)),
        carrier.jet,
        r0,
        factory.thickness,
        (carrier.dx(), carrier.dS()),
        m,
        carrier.widths,
        list(_ends(model, r0, m)),
        factory.folded,
    )


def _ends(model: ShellModel, r0: Jet, m: Expr) -> Iterator[Edge]:
    for term in model.system.terms:
        if not isinstance(term, ShellTerm) or term.density.facets is None or not term.name.endswith(" edges"):
            continue
        rest, along = term.density.parameters[3:], model.factory.carrier.ds(term.density.facets)
        if "mirror" in term.name:
            yield Edge(mirrored_jump(r0, m, rest[0]), 2, along)
            continue
        turned = any(p.ufl_shape == (3, 3) for p in rest if isinstance(p, fem.Constant))
        yield Edge(held_jump(r0, m, ufl.dot(rest[0], kin.normal(r0)) if turned else kin.normal(r0)), 1, along)
