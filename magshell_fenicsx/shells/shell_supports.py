"""Supports and mirror planes of a shell: displacement constraints and energies of edges.

Edges, patches and points have conditions by name. An edge that is clamped, or that lies on a mirror
plane, has an energy too, since a C0 displacement alone does not hold its normal.

A condition is what the case says of an edge, patch or point: "free"; "clamped", with the normal
held; "symmetry", on a mirror plane of the modelled half or sector; "plane", on a symmetry plane of
the shell itself; or the displacement components that are zero. A support is what a model holds by a
condition: constraints of the displacement, and perhaps the energy of an edge with its name and a
rotation. Facets are the local edges of triangles.
"""

from collections.abc import Mapping

import numpy as np
from dolfinx import fem

from magshell_fenicsx.assembly.oblique_supports import Constraint, support_along
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.mirror import SYMMETRY_EDGE, Mirror
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.laminate import Laminate
from magshell_fenicsx.models.shell.parameters import Condition, HeldComponents
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.supports.support_motion import Support, SupportKind, rotation_of
from magshell_fenicsx.parts.supports.supports import held_at_vertex, held_on, plane_of
from magshell_fenicsx.shells.energy_factory import EnergyFactory

ALL_COMPONENTS = (0, 1, 2)


class ShellSupports:
    """Supports of a shell on a mid-surface. Construction is collective.

    Parameters
    ----------
    r0
        Placement of the shell.
    conditions
        Edge, patch or point -> condition.
    mirror_planes
        Edge on a symmetry plane of the modelled part -> that plane.
    laminates
        Shell -> its plies; the name is empty where there is one shell.
    loads
        Loads, which may move supports.
    factory
        Factory that makes the energies of edges.

    Raises
    ------
    MeshError
        On every rank, if an edge lies in no plane, or its plane does not mirror the plies.

    Attributes
    ----------
    terms
        Energies of edges on mirror planes, then those of the conditions in their order.
    constraints
        Constraints of the displacement by the conditions.
    mirror_constraints
        Constraints on the symmetry planes of the modelled part.
    mirror_term
        Energy of the edges on the last of these planes; None of a whole shell.
    planes
        All planes, those of the modelled part first.
    by_name
        Edge, patch or point -> its support; those on planes that belong to the shell come last.
    _r0, _V, _midsurface, _laminates, _loads, _factory
        The parameters, and the space of the placement.
    _clamped
        Names of the clamped edges.
    """

    def __init__(
        self,
        r0: fem.Function,
        midsurface: Midsurface,
        conditions: Mapping[str, Condition],
        mirror_planes: Mapping[str, Mirror],
        laminates: Mapping[str, Laminate],
        loads: Loads,
        factory: EnergyFactory,
    ) -> None:
        """Make all constraints and edge energies; parameters are those of the class."""
        self._r0, self._V, self._midsurface = r0, r0.function_space, midsurface
        self._laminates, self._loads, self._factory = laminates, loads, factory
        self._clamped = [
            name
            for name, condition in conditions.items()
            if condition == "clamped" and name in midsurface.edges
        ]
        self.terms: list[FormTerm] = []
        self.constraints: list[Constraint] = []
        self.mirror_constraints: list[Constraint] = []
        self.mirror_term: FormTerm | None = None
        self.planes: list[Mirror] = []
        self.by_name: dict[str, Support] = {}
        for name, plane in mirror_planes.items():
            self._add_mirror_plane(name, plane)
        # supports on the shell's own planes come last in `by_name`
        on_planes: dict[str, Support] = {}
        for name, condition in conditions.items():
            # mirror planes have been added above
            if condition in ("free", "symmetry"):
                continue
            if condition == "plane":
                on_planes[name] = self._add_plane_of_shell(name)
            else:
                self.by_name[name] = self._add_support(name, condition)
        self.by_name |= on_planes

    def _add_mirror_plane(self, name: str, plane: Mirror) -> None:
        """Add the symmetry plane of an edge of the modelled part: energy and constraint."""
        self.planes.append(plane)
        facets = self._midsurface.edges[name]
        # name of the energy; that of the second plane of a sector must be another one
        edge = "mirror edges" if name == SYMMETRY_EDGE else f"{name} mirror edges"
        energy = self._factory.mirror_edges(facets, plane.normal, edge)
        self.mirror_term = self._factory.term(energy)
        self.terms.append(self.mirror_term)
        self.mirror_constraints.append(support_along(self._V, 1, facets, plane.normal))

    def _add_plane_of_shell(self, name: str) -> Support:
        """Add the plane of an edge with the condition "plane", and return its support.

        The plane is a symmetry of the shell itself.

        Raises
        ------
        MeshError
            If the plane does not mirror the plies of the shell.
        """
        facets = self._midsurface.edges[name]
        plane = plane_of(self._r0, facets, name)
        self.planes.append(plane)
        if not all(laminate.mirrored(plane) for laminate in self._laminates_at(name)):
            raise MeshError(
                f"boundary: {name}: its plane does not mirror the plies, which are neither along "
                "nor across it"
            )
        edge = f"{name} mirror edges"
        energy = self._factory.mirror_edges(facets, plane.normal, edge)
        self.terms.append(self._factory.term(energy))
        self.constraints.append(support_along(self._V, 1, facets, plane.normal))
        # The constraint across the plane has been added. These constraints are not put on the
        # displacement: they only tell which unknowns belong to the support.
        edge_constraints = held_on(self._V, 1, facets, ALL_COMPONENTS)
        return Support.from_conditions(edge_constraints, edge, kind="plane")

    def _laminates_at(self, edge: str) -> list[Laminate]:
        """Return the laminates of the shell that has an edge; empty without plies."""
        return [
            laminate
            for shell, laminate in self._laminates.items()
            # a model's only shell has an empty name
            if not shell or edge.startswith(f"{shell}_")
        ]

    def _add_support(self, name: str, condition: Condition) -> Support:
        """Add the support of an edge, patch or point, and return it.

        A clamped edge also gets an energy that holds its normal, turned by a load that moves it.
        """
        if isinstance(condition, HeldComponents):
            components = condition.components
        else:
            components = ALL_COMPONENTS
        # name of the edge's energy, and rotation of its normal; neither unless it is clamped
        edge, turn = "", None
        if name in self._clamped:
            # energies of several clamped edges need a name each
            edge = f"{name} clamped edges" if len(self._clamped) > 1 else "clamped edges"
            turn = rotation_of(self._loads, name, self._V)
            facets = self._midsurface.edges[name]
            energy = self._factory.clamped_edges(edge, facets, turn)
            self.terms.append(self._factory.term(energy))
        constraints = self._constraints_of(name, components)
        self.constraints += constraints
        kind: SupportKind = "point" if name in self._midsurface.points else "part"
        return Support.from_conditions(constraints, edge, turn, kind=kind)

    def _constraints_of(self, name: str, components: tuple[int, ...]) -> list[fem.DirichletBC]:
        """Return the constraints of displacement components on a line, on a patch or at a point.

        `components` are numbers 0 to 2 of the axes.
        """
        midsurface = self._midsurface
        if name in midsurface.edges:
            return held_on(self._V, 1, midsurface.edges[name], components)
        if name in midsurface.patches:
            cells = np.flatnonzero(midsurface.patches[name]).astype(np.int32)
            return held_on(self._V, 2, cells, components)
        if name in midsurface.inner_lines:
            return held_on(self._V, 1, midsurface.inner_lines[name], components)
        cells_at_point = midsurface.cells_of_point(name)
        return held_at_vertex(self._V, midsurface.points[name], components, cells_at_point)
