"""The body of a shell as a three-dimensional solid: a system of terms, with the interface of `ShellModel`.

Lengths in R, energies in E h R^2, amplitudes as in `ShellModel`. Displacements are those of nodes in the middle
of the thickness; the pressure, the volume and the loaded patch are of the outer face.
"""

from collections.abc import Iterable, Mapping
from functools import cached_property

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.problem import FiniteElementSystem
from magshell_fenicsx.assembly.sliding import Constraint, held_along
from magshell_fenicsx.assembly.terms import LinearTerm, Term
from magshell_fenicsx.mesh.hexahedra import Body, quadratic
from magshell_fenicsx.mesh.mirror import Y0, Mirror
from magshell_fenicsx.models.observed import Observed
from magshell_fenicsx.models.shell.antisymmetric import AntisymmetricModes
from magshell_fenicsx.models.shell.fast_tangent import FastTangent
from magshell_fenicsx.models.shell.free import free_parameters
from magshell_fenicsx.models.shell.parameters import Condition, Force, Loads, Material
from magshell_fenicsx.models.solid.material import NeoHookean
from magshell_fenicsx.models.solid.sites import make_sites
from magshell_fenicsx.models.solid.terms import TermFactory


class SolidModel(Observed):
    """A neo-Hookean, hard-magnetic body around a mid-surface.

    Parameters
    ----------
    conditions
        Edge of the mid-surface -> "clamped", "symmetry" or "free", of the face above it.
    loads
        The remanence is uniform, its energy the full one; a force has a patch, on the outer face.
    mirror
        The plane of the faces with the condition "symmetry", of a half model.

    Attributes
    ----------
    system, multiplicity, normals, kernels
        As of `ShellModel`.
    degree
        Of the displacement: 2.
    sigma
        None: nothing is penalised.
    """

    degree = 2
    sigma = None

    def __init__(
        self,
        body: Body,
        material: Material,
        neo_hookean: NeoHookean,
        conditions: Mapping[str, Condition],
        loads: Loads,
        mirror: Mirror = Y0,
    ) -> None:
        self.body, self.material, self.neo_hookean, self.loads = body, material, neo_hookean, loads
        self.normals = body.normals
        self.multiplicity = 2 if "symmetry" in conditions.values() else 1
        self.kernels = KernelLog()
        self.V = V = quadratic(body.mesh)
        self.u, self.r0 = fem.Function(V, name="u"), fem.Function(V, name="r0")
        self.r0.interpolate(lambda x: x)
        self._factory = factory = TermFactory(body, self.u, neo_hookean, material.h, self.kernels)
        self._pattern = factory.distortion()
        origin = mirror.offset * mirror.normal
        self._terms: list[Term] = [self._pattern, factory.compression()]
        if loads.magnetic:
            self._terms += factory.magnetic(loads.magnetic)
        if loads.pressure:
            self._terms.append(factory.pressure(material.classical_pressure, origin))
        self._terms += [factory.own(term) for term in loads.own]
        self.observed = self.kernels.compile_all(factory.observed(term) for term in loads.own)
        if loads.force:
            self._terms.append(self._force(loads.force))
        self._held = _held(V, [body.faces[n] for n, c in conditions.items() if c == "clamped"], range(3))
        self._faces = [body.faces[n] for n, c in conditions.items() if c == "symmetry"]
        self.mirror = mirror
        self._sites = make_sites(body, self.r0, self._terms, self.kernels)
        self.system = self._system(self._held + self._held_on_mirror([mirror.normal]))
        self.observe(self.kernels.compile("volume energy", factory.volume_change(origin)), body.points)

    @cached_property
    def excluded_modes(self) -> AntisymmetricModes | None:
        """The modes that a half model does not see: moved freely across the mirror plane and not in it."""
        if self.multiplicity == 1:
            return None
        return AntisymmetricModes(self._system(self._held + self._held_on_mirror(self.mirror.in_plane)))

    def _held_on_mirror(self, directions: Iterable[NDArray[np.float64]]) -> list[Constraint]:
        return [held_along(self.V, 2, facets, along) for facets in self._faces for along in directions]

    def _system(self, held: list[Constraint]) -> FiniteElementSystem:
        fast, factory = FastTangent(self.u, self._sites, held), self._factory
        parameters = free_parameters(
            self.loads.own, factory.free, factory.own, lambda term: self.kernels.compile_all([factory.observed(term)])
        )
        return FiniteElementSystem(
            self.u, self._terms, held, self._pattern, self.material.h, fast, parameters=parameters
        )

    def _force(self, force: Force) -> LinearTerm:
        """Averaged over the outer face with the weight (1 - d^2/radius^2)^2, d the distance from the loaded point."""
        normal, domain = self.body.normals[force.point], self.V.mesh
        values = self.body.points[force.point] + self.material.h / 2 * normal, force.patch, -normal
        centre, a, along = (fem.Constant(domain, value) for value in values)
        d = ufl.SpatialCoordinate(domain) - centre
        inside = 1 - ufl.dot(d, d) / a**2
        weight, ds = ufl.conditional(ufl.gt(inside, 0), inside**2, 0), self._factory.outer_measure()
        total = domain.comm.allreduce(fem.assemble_scalar(self.kernels.compile("patch weight", weight * ds)))
        form = self.kernels.compile("patch load", weight * ufl.dot(along, ufl.TestFunction(self.V)) * ds)
        load = fem.assemble_vector(form)
        load.scatter_reverse(InsertMode.add)
        dofs = np.flatnonzero(load.array[: 3 * self.V.dofmap.index_map.size_local]).astype(np.int32)
        return LinearTerm("force", dofs, self.force_unit * load.array[dofs] / total, self.u, "force")


def _held(V: fem.FunctionSpace, faces: list[NDArray[np.int32]], components: range) -> list[Constraint]:
    """Some components zero on some faces."""
    facets = np.unique(np.concatenate(faces)).astype(np.int32) if faces else np.empty(0, np.int32)
    spaces = [V.sub(i) for i in components] if faces else []
    return [fem.dirichletbc(0.0, fem.locate_dofs_topological(W, 2, facets), W) for W in spaces]
