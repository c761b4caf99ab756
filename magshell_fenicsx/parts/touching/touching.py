"""Contact of a shell with itself or of its parts with each other: the penalty of the gap between
their faces.

Each mid-surface has points of a quadrature. The gap of a point x is |x - y| - h with the nearest
place y of the other mid-surface: the faces are half a thickness from both. Both surfaces have
points, so that each has half of the penalty. A gap is a function of the state alone, and has no
side: see `through` for steps that would pass through. The points are those of a rule on each cell;
where cells face others, they are on parts that each face one of them, see `segments`.

With beta = (N_x, -N_y) of the nodes of both cells, n = (x - y)/d, d the distance and F = d^2/2:

    d,u = beta n,   d,uu = [beta beta (I - n n) - C^T A^-1 C]/d,   C_a = -beta y_a - d n (0, N_y,a),   A = F,ab

where A is the Hessian of F by the place of y, which moves along. P. Wriggers, Computational Contact
Mechanics, Springer 2006, sec. 4.1 and 9.

Where the thickness varies, half of it H at nodes is a fourth unknown: d is then the least of |x -
y| - H(y), less H(x), plus h, so that |x - y| need not be the least. Of shells that get thinner H
follows from the displacement (`Faces`).
"""

from collections.abc import Callable

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.global_mesh import add_to_owners, global_values
from magshell_fenicsx.assembly.nonlocal_terms import Entries, pairs_of
from magshell_fenicsx.parts.gap import SOFT, penalty
from magshell_fenicsx.parts.touching.by_fields import Present, Shape, Weights, by_factor, by_place
from magshell_fenicsx.parts.touching.expanded import Expanded
from magshell_fenicsx.parts.touching.faces import (
    Faces,
    between,
    geometry,
    hessians,
    slope_of,
    unknowns,
)
from magshell_fenicsx.parts.touching.facing import BLUR, SAME, Facing, nowhere
from magshell_fenicsx.parts.touching.in_steps import Along, ContactTerm, Kept, Number
from magshell_fenicsx.parts.touching.nearest import Cells, Joined, Longs, Places
from magshell_fenicsx.parts.touching.section import Pair
from magshell_fenicsx.parts.touching.segments import Cuts, Points, Segments, divisions_of

Array = NDArray[np.float64]
REACH = 4.0  # thicknesses: farther places are not looked for
AHEAD = 1.0  # of the thickness: cells that are nearer than that have room in the tangent
EVERYWHERE = 1 - 1e-9  # of the area of a cell, but for rounding
CHUNK = 1000  # blocks of a tangent at a time
# of the force, on points that face another cell than where the cuts were made: then they are made
# anew
ASTRAY = 0.1
MOST_DIVISIONS = 8  # of triangles in a zone of contact: each halves the distance of its points
PART = 0.25  # of the thickness: how far points move between two looks at a step
# of the thickness: a smaller distance between mid-surfaces is one of those that pass through each
# other
NEARER = 0.5


class Touching(ContactTerm):
    """The energy of the contact of a pair; an `assembly.terms.Term` and `assembly.nonlocal_terms.NonlocalTerm`.

    Parameters
    ----------
    segments
        Gives the points on all cells of this rank, also where these face others.
    allowed
        Whether points of cells (n,) may touch cells (n,).
    h
        Thickness over R: that of the penalty and of the search where it varies.
    r0, u
        All nodes (nodes, 3) undeformed, and their displacement at present; the latter is
        collective.
    own, local
        Number of the first degree of freedom and of the first cell of this rank; how many it has,
        of cells with ghosts.
    nodes
        Of both parts.
    shape
        The fields that the gap depends on.
    faces
        How far they are from the mid-surface where the thickness varies, or changes with the state;
        None where it is h.
    """

    def __init__(
        self,
        pair: Pair,
        cells: Cells,
        segments: Segments,
        allowed: Callable[[Longs, Longs], NDArray[np.bool_]],
        h: float,
        r0: Array,
        u: Callable[[], Array],
        own: tuple[int, int],
        local: tuple[int, int],
        comm: MPI.Comm,
        nodes: Longs,
        shape: Shape,
        faces: Faces | None = None,
    ) -> None:
        super().__init__(pair, shape, faces)
        self.cuts, rule = Number(0.0), segments.rule
        self._cells, self._rule, self._segments, self._h = cells, rule, segments, h
        self._r0, self._u, self._own, self._local, self._comm = r0, u, own, local, comm
        self._parts = 4 if faces else 3  # of vectors, see `nearest`
        self._facing = Facing(cells, rule, allowed, h, r0, faces, comm)
        self._touched = nodes
        self._far = h + (REACH - 1) * 2 * float(self._facing.half[nodes].max())
        self._at = np.full_like(r0, np.nan)
        self._grown = 0.0  # the natural stretch there
        self._cuts = Cuts(segments, self._near, self._gaps, r0)
        self._points, self._places, self._left = rule, nowhere(), nowhere()
        self._joined = Joined.of(self._places, 1.0)
        self._looked_at = Kept[tuple[Places, Places, Joined]]()
        self._cells_at = Kept[tuple[Array, Array, NDArray[np.bool_]]]()
        self._about: Expanded | None = None
        self._made: tuple[Places | None, float, Entries] = (
            None,
            0.0,
            (np.zeros(0, np.int64),) * 2 + (np.zeros(0),),
        )

    # as a term

    @property
    def history(self) -> dict[str, tuple[Number, float]]:
        """See `FiniteElementSystem`; without a number of its own, a state has the cuts of the
        undeformed surfaces.
        """
        return super().history | {self.pair.cuts: (self.cuts, 0.0)}

    def energy(self) -> float:
        at, joined, (value, _, _) = self._pressed()
        return float(self._points.weight[at.point[joined.first]] @ value) / 2

    def _entries(self) -> Entries:
        """Those of the present state, once for the tangent and its products; of looks each time."""
        at, *_ = self._pressed()
        places, k, made = self._made
        if places is at and k == self.stiffness.value and not self.look:
            return made
        entries = self._by_parts()
        entries = (
            self._faces.entries(self._at, entries, self._forces()[:, 3]) if self._faces else entries
        )
        if not self.look:
            self._made = at, self.stiffness.value, entries
        return entries

    @property
    def pattern_key(self) -> float:
        """See `NonlocalTerm`: the number of the cuts."""
        return self.cuts.value

    def coupled_pairs(self) -> tuple[Longs, Longs]:
        """See `NonlocalTerm`: the nodes of cells that touched, or nearly did, where the cuts were made."""
        self._pressed()
        number, u = len(self._cells.nodes), self._cuts.displacement(self.cuts.value)
        ahead = self._h + AHEAD * (self._far - self._h) / (REACH - 1)
        at = self._facing.places_in(self._points, u, self._facing.placed(u), ahead)
        keys = np.unique(self._points.cell[at.point] * number + at.cell)
        nodes = np.concatenate(
            [self._cells.nodes[keys // number], self._cells.nodes[keys % number]], axis=1
        )
        return self._faces.coupled_pairs(*pairs_of(nodes)) if self._faces else pairs_of(nodes)

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """Of thickness and placement; see `assembly.nonlocal_terms.FieldDifferentiable`; collective."""
        field = {"thickness": self._shape.thickness, "r0": self._shape.r0}.get(name)
        if field is None:
            return None
        now, weights = (
            self._present(),
            Weights(self._of_copies(global_values(direction)), energy, force),
        )
        if name == "thickness":
            of_cells = self._comm.allreduce(self._in_modelled(by_factor(now, weights)))
            return field, of_cells[self._shape.own, :, None]
        return field, self._shape.shared(
            self._comm.allreduce(self._on_modelled(by_place(now, weights)))
        )

    def _present(self) -> Present:
        places, joined, pressed = self._pressed()
        of_all = self._cells, self._r0, self._at, self._faces, self._points
        found = self._by_parts, self._entries, self._geometry
        return Present(*of_all, places, joined, pressed, self._forces(), *found)

    def _add(self, b: Array, forces: Array) -> None:
        """Add forces (nodes, 3) of this rank's points; collective."""
        add_to_owners(b, forces, self._own, self._comm)

    def _by_parts(self) -> Entries:
        """Those of the second derivative by place and thickness."""
        global_values, joined, (_, of_group, bend) = self._pressed()
        number, several = len(self._cells.nodes), joined.several
        first = of_group[joined.group]
        second = np.where(several[joined.group], first / (BLUR * self._h), bend[joined.group])
        weight = joined.weight * self._points.weight[global_values.point] / 2
        order = np.argsort(
            self._points.cell[global_values.point] * number + global_values.cell, kind="stable"
        )
        at, first, second, weight = (
            global_values.of(order),
            first[order],
            second[order],
            weight[order],
        )
        keys = self._points.cell[at.point] * number + at.cell
        starts = np.flatnonzero(np.diff(keys, prepend=-1))
        rows, columns, values = list[Longs](), list[Longs](), list[Array]()
        for some in np.array_split(starts, max(1, len(keys) // CHUNK)):
            if not len(some):
                continue
            after = starts[np.searchsorted(starts, some[-1]) + 1 :]
            part = slice(some[0], after[0] if len(after) else len(keys))
            some_at = at.of(part)
            geometry, placed = self._geometry(some_at), self._facing.placed(self._at)
            H = hessians(
                self._cells, some_at, geometry, placed, (weight[part], first[part], second[part])
            )
            nodes = geometry[3]
            sums = np.add.reduceat(H, some - some[0], axis=0)
            dofs = unknowns(nodes[some - some[0]], len(self._r0), self._parts)
            i, j = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
            rows.append(i.ravel())
            columns.append(j.ravel())
            values.append(sums.ravel())
        nothing = np.zeros(0, dtype=np.int64)
        if not rows:
            return nothing, nothing, np.zeros(0)
        if several.any():
            jointly = several[joined.group]
            _, n, beta, nodes = self._geometry(global_values.of(jointly))
            slopes = joined.weight[jointly, None, None] * slope_of(n, beta, self._parts)
            of_joined = (
                self._points.weight[global_values.point[joined.first]]
                / 2
                * (bend - of_group / (BLUR * self._h))
            )
            i, j, v = between(slopes, nodes, joined.group[jointly], of_joined, len(self._r0))
            rows, columns, values = [*rows, i], [*columns, j], [*values, v]
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)

    # what is seen

    def force(self) -> float:
        """The sum of the pressures over the contact, over E h R; collective."""
        at, joined, (_, first, _) = self._pressed()
        return float(
            self._comm.allreduce(float(self._points.weight[at.point[joined.first]] @ first / 2))
        )

    def least_gap(self) -> float:
        """Over R; nan where no places face each other within the reach; collective."""
        self._pressed()
        least = self._facing.least_distance(self._now(), self._far, self._points)
        return least - self._h if least < self._far else np.nan

    def penetration(self) -> float:
        """The largest, over R; 0 where nothing touches; collective."""
        at, *_ = self._pressed()
        return float(self._comm.allreduce(float((self._h - at.distance).max(initial=0.0)), MPI.MAX))

    def depth(self) -> float:
        """The same over the undeformed thickness there."""
        at, *_ = self._pressed()
        deep = (
            (self._h - at.distance) / self._facing.thickness(self._points, at)
            if len(at.point)
            else at.distance
        )
        return float(self._comm.allreduce(float(deep.max(initial=0.0)), MPI.MAX))

    def deepest(self) -> tuple[float, Array]:
        """The largest penetration over R, and its place (3,); collective."""
        at, *_ = self._pressed()
        mine = (0.0, np.zeros(3))
        if len(at.point):
            worst = int(at.distance.argmin())
            x = self._facing.x_of(self._points, self._r0 + self._now(), at.point[[worst]])[0]
            mine = (float(self._h - at.distance[worst]), x)
        deep, place = max(self._comm.allgather(mine), key=lambda each: each[0])
        return float(deep), np.asarray(place)

    def of_cells(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """See `_found_of_cells`; it is found once for a state. Collective."""
        self._pressed()
        if self._about:
            return self._found_of_cells()
        return self._cells_at.of(
            (self._at, self.cuts.value, self._grown, self.stiffness.value), self._found_of_cells
        )

    def _found_of_cells(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """The mean pressure over E h/R, the least gap over R within the reach, and which are
        pressed all over.

        Of local cells.

        Where an edge alone presses on a face, half of its points' forces acts on each, as the
        energy has it. Of ghosts the pressure is zero and the gap the reach. Collective.
        """
        at, joined, (_, first, _) = self._pressed()
        points, (start, count) = self._points, self._local
        nearest = at.of(joined.first)
        alone = self._facing.press_alone(
            points, nearest, self._cuts.points(self.cuts.value, self._now())[1]
        )
        size = points.weight[nearest.point] * first
        faced = np.bincount(nearest.cell, size / 2 * alone, len(self._cells.nodes)).astype(
            np.float64
        )
        pushed = self._comm.allreduce(self._in_modelled(faced[:, None])[:, 0])[self._shape.own]
        weight, p, gap = np.ones(count), np.zeros(count), np.full(count, self._far - self._h)
        np.add.at(weight, points.cell - start, points.weight)
        weight[: len(np.unique(points.cell))] -= 1.0
        p[: len(pushed)] = pushed
        np.add.at(p, points.cell[nearest.point] - start, size * (1 - alone / 2))
        near = self._facing.found(self._now(), self._far, points, least=True)
        np.minimum.at(gap, points.cell[near.point] - start, near.distance - self._h)
        pressed = np.zeros(count)
        some = np.unique(nearest.point)
        np.add.at(pressed, points.cell[some] - start, points.weight[some])
        return p / weight, gap, pressed > EVERYWHERE * weight

    def halves(self) -> tuple[Array, Array]:
        """Half the undeformed thickness at all nodes, and the present one, over R; collective."""
        undeformed = self._facing.half
        return undeformed, self._faces.half(self._now()) if self._faces else undeformed

    def thinnest(self, *displaced: Array) -> float:
        """The least thickness of both parts over R, undeformed and at displacements of all nodes."""
        half = self._facing.half, *(self._faces.half(u) for u in displaced if self._faces)
        return 2 * min(float(each[self._touched].min()) for each in half)

    def meet(self, u: Array, v: Array) -> bool:
        """Whether any cells come near each other between two displacements of all nodes;
        collective.
        """
        return self._facing.near_on_way(self._of_copies(u), self._of_copies(v))

    def gap(self, u: Array) -> float:
        """The least one of uncut cells, over R, at a displacement of all nodes, as far as the
        reach; collective.
        """
        return self._facing.least_distance(self._of_copies(u), self._far) - self._h

    def held_gap(self, held: Longs, u: Array) -> float:
        """See `Facing.held_gap`."""
        return self._facing.held_gap(held, self._of_copies(u))

    def through(self, u: Array, v: Array) -> bool:
        """Whether points pass through a surface on the straight way between two displacements of
        all nodes; collective.

        Between two looks none moves, relative to another, by more than a part of the least
        thickness.
        """
        return self.passes(self._of_copies(u), self._of_copies(v))

    def passes(self, u: Array, v: Array) -> bool:
        """The same of displacements of all that is faced."""
        moved, least = v - u, self.thinnest(u, v)
        moved = moved - moved.mean(axis=0)
        looks = int(np.ceil(2 * np.linalg.norm(moved, axis=1).max() / (PART * least)))
        if not self._facing.near_on_way(u, v):
            return False
        for k in range(1, looks):
            near = self._facing.found(u + k / looks * (v - u), NEARER * least, faces=False)
            if self._comm.allreduce(len(near.point)):
                return True
        return False

    # in a step in time, see `in_steps.InSteps`

    @property
    def where(self) -> Array:
        """The displacement of all that is faced; collective."""
        return np.array(self._now())

    def along(self, moved: Array) -> Along:
        """See `InSteps`."""
        at, joined, _ = self._pressed()
        if self._faces:
            moved = np.column_stack([moved, self._faces.change(self._at, moved)])
        _, n, beta, nodes = self._geometry(at)
        moves = -np.einsum("nki,nki->n", slope_of(n, beta, self._parts), moved[nodes])
        moves = np.bincount(joined.group, joined.weight * moves, len(joined.first))
        point, k = at.point[joined.first], self.stiffness.value
        return Along.of(
            len(self._points.weight), point, self._h - joined.distance, moves, k, SOFT * self._h
        )

    def recut(self) -> float | None:
        """The number of the present displacement, if cuts there are better than those of the state;
        collective.

        The measure is the part of the force on points that do not face what they faced where the
        cuts were made, or face an edge that was steep there and is no more, or the other way round.
        """
        u = self._now()
        at, *_ = self._pressed()
        now = self._segments.normals(self._r0 + u)
        turned = self._force(self._points, at.of(self._facing.left_to_edges(self._points, at, now)))
        turned += self._force(
            self._points, self._left.of(~self._facing.left_to_edges(self._points, self._left, now))
        )
        astray = self._astray(self._points, at, turned)
        if astray <= ASTRAY:
            return None
        points, counted = self._with_cuts_at(u, self._divisions)
        better = self._astray(points, counted) < astray / 2
        return self._cuts.numbered(u, self._divisions) if better else None

    def finer(self) -> float | None:
        """The number of the present displacement with triangles in the zone of contact divided once
        more; collective.

        None if nothing touches, or if they are divided `MOST_DIVISIONS` times.
        """
        u, divisions = self._now(), self._divisions
        at, *_ = self._pressed()
        if divisions == MOST_DIVISIONS or not self._comm.allreduce(len(at.point)):
            return None
        return self._cuts.numbered(u, divisions + 1)

    def numbered(self) -> float:
        """The number of the present displacement, for cuts there; collective."""
        return self._cuts.numbered(self._now(), self._divisions)

    @property
    def _divisions(self) -> int:
        return divisions_of(self.cuts.value)

    def _with_cuts_at(self, u: Array, divisions: int) -> tuple[Points, Places]:
        """The points with cuts at a displacement, and their places that count there."""
        points, normals = self._cuts.at(u, divisions)
        places = self._facing.found(u, self._h, points)
        return points, places.of(~self._facing.left_to_edges(points, places, normals))

    def recall(self, number: float) -> None:
        """Let a number stand for the present displacement: it may be that of a run on other ranks;
        collective."""
        self._cuts.recall(number, self._now())

    def _astray(self, points: Points, at: Places, turned: float = 0.0) -> float:
        """The part of the force at points that do not face what they faced, on what is `turned`, or
        where triangles are divided less often than in the zone of contact."""
        elsewhere = points.faces[at.point] != at.cell
        other = at.of(elsewhere | (points.divisions[at.point] < self._divisions))
        global_values, part = self._comm.allreduce(
            np.array([self._force(points, at), self._force(points, other) + turned])
        )
        return float(part / global_values) if global_values else float(part > 0)

    def _force(self, points: Points, at: Places) -> float:
        """Twice that of this rank on the nearest of some places."""
        nearest = at.of(at.firsts)
        pressures = penalty(self._h - nearest.distance, self.stiffness.value, SOFT * self._h)[1]
        return float(points.weight[nearest.point] @ pressures)

    def _near(self, u: Array) -> Places:
        """The places in all cells that may press on cells of this rank at a displacement."""
        far = self._h + self._segments.within
        near = self._facing.places_in(self._rule, u, self._facing.placed(u), float(far.max()))
        return self._facing.of_far_cells(
            self._rule, near.of(near.distance < far[self._rule.cell[near.point]])
        )

    def _gaps(self, points: Points, u: Array) -> Array:
        """The gaps (n,) of points at a displacement over R, as far as they are looked for."""
        places = self._facing.found(u, self._far, points)
        distance = np.full(len(points.cell), self._far)
        np.minimum.at(distance, places.point, places.distance)
        return np.asarray(distance - self._h)

    # geometry

    def _now(self) -> Array:
        return self.look.u if self.look else self._u()

    def _of_copies(self, u: Array) -> Array:
        """The displacement of all that is faced, of the nodes that are modelled."""
        return u

    def _in_modelled(self, values: Array) -> Array:
        """Derivatives by values in modelled cells, of those in all cells."""
        return values

    def _on_modelled(self, forces: Array) -> Array:
        """Those (nodes, 3) on modelled nodes, of those on all."""
        return forces

    def _forces(self) -> Array:
        """The derivative (nodes, 3) of this rank's energy by the places of all nodes, or (nodes,
        4).
        """
        at, joined, (_, first, _) = self._pressed()
        forces = np.zeros((len(self._r0), self._parts))
        if len(at.point):
            _, n, beta, nodes = self._geometry(at)
            share = joined.weight * self._points.weight[at.point] / 2 * first[joined.group]
            np.add.at(forces, nodes, -share[:, None, None] * slope_of(n, beta, self._parts))
        return forces

    def _pressed(self) -> tuple[Places, Joined, tuple[Array, Array, Array]]:
        """The places that are pressed at the present state, how they are joined, and the penalty of each joined one
        with its derivatives by the penetration."""
        if self._about:
            self._at, self._points = np.array(self._now()), self._about.points
            given = self._facing, self._at, self.stiffness.value, self._h
            return self._about.at(*given, bends=self.held is not None)
        u, grown = self._now(), self._faces.value if self._faces else 0.0
        points, normals = self._cuts.points(self.cuts.value, u)
        if points is not self._points or grown != self._grown or not np.array_equal(u, self._at):
            self._points, self._grown, self._at = points, grown, np.array(u)
            kept = self._looked_at.of(
                (u, self.cuts.value, grown), lambda: self._faced(points, normals, u)
            )
            self._places, self._left, self._joined = kept
        joined = self._joined
        pressed = penalty(self._h - joined.distance, self.stiffness.value, SOFT * self._h)
        return (
            self._places,
            joined,
            self.look.of(self._places.point[joined.first], pressed) if self.look else pressed,
        )

    def _faced(self, points: Points, normals: Array, u: Array) -> tuple[Places, Places, Joined]:
        """The places that count, those left to edges, and how the former are joined."""
        places = self._facing.found(u, (1 + SAME) * self._h, points)
        left = self._facing.left_to_edges(points, places, normals)
        return places.of(~left), places.of(left), Joined.of(places.of(~left), BLUR * self._h)

    def pressed(self) -> Expanded:
        """What is pressed at the present state."""
        self._pressed()
        return Expanded.of(self._cells, self._r0, self._h, self._points, self._places, self._joined)

    def expand_about(self, pressed: Expanded) -> None:
        """Take for good what is pressed in another scene on the same mesh, see `expanded`."""
        self._made = None, 0.0, self._made[2]
        self._about = pressed.on(self._r0)

    def _geometry(self, at: Places) -> tuple[Array, Array, Array, Longs]:
        return geometry(self._cells, self._points, self._r0 + self._at, at)
