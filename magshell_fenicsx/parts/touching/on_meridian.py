"""Contact of shells with one axis on their meridians: the same penalty of the same gap as
`touching`, for curves.

A point x of one curve has the nearest place y of the other. Both curves have points, so that each
has half of the penalty. With d = |x - y|, n = (x - y)/d, F = d^2/2, A = F,ss = |y'|^2 - (x - y) .
y'' and changes D = dx - dy:

    d,uu = [D . D - (n . D)^2 - C_s^2/A - C_theta^2/B]/d,   C_s = -D . y' - (x - y) . dy',   B = rho_x rho_y

Where the thickness varies d is the least of |x - y| - H(y), less H(x), plus h, with half the
thickness H. Then n . y' is -H', C_s has y' less its part along n, and A is |y'|^2 - (x - y) . y'' -
H'^2 - |x - y| H''. H less h/2 is a third component of places.

Along e_theta the nearest place moves as it does along the curve. A wave (U cos, V sin, W cos) of m
theta moves it by C_theta = -rho_y D_V + (x - y)_rho (m U_y + V_y) + (x - y)_z m W_y; without waves
it stays. The points are those of a rule on each cell. At a free end one is next to the end, which
an edge stands on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.nonlocal_terms import Entries, pairs_of
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.parts.gap import SOFT, Grown, expanded, penalty
from magshell_fenicsx.parts.touching.building import WITHIN
from magshell_fenicsx.parts.touching.by_fields import Present, Shape, Weights, by_factor, by_place
from magshell_fenicsx.parts.touching.curves import (
    SAME,
    SIGNS,
    Around,
    Close,
    Curves,
    Faced,
    distances,
    nowhere,
    slopes,
)
from magshell_fenicsx.parts.touching.faces import slope_of, unknowns
from magshell_fenicsx.parts.touching.facing import STEEP, between_held
from magshell_fenicsx.parts.touching.in_steps import Along, ContactTerm, Kept, of_each
from magshell_fenicsx.parts.touching.nearest import FOLLOWING, Joined, highest
from magshell_fenicsx.parts.touching.rings import IN_PLANE, Rings
from magshell_fenicsx.parts.touching.section import WHOLE, Pair
from magshell_fenicsx.parts.touching.touching import EVERYWHERE, NEARER, PART, REACH

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Inside = NDArray[np.bool_]


class MeridianTouching(ContactTerm):
    """The energy of the contact of a pair on the meridian; an `assembly.terms.Term` and
    `assembly.nonlocal_terms.NonlocalTerm`.

    Parameters
    ----------
    sides
        Whether each cell belongs to the first shell, and to the second.
    curves
        The meridians of all shells.
    r0
        (nodes, 2) undeformed.
    h
        Thickness over R: that of the penalty and of the search where it varies.
    degree
        Of the quadrature.
    shape
        The fields that the gap depends on.
    faces
        How far they are from the meridian where the thickness varies, or changes with the state;
        None where it is h.
    """

    def __init__(
        self,
        pair: Pair,
        curves: Curves,
        r0: Array,
        u: fem.Function,
        sides: tuple[Inside, Inside],
        h: float,
        degree: int,
        shape: Shape,
        faces: Rings | None = None,
    ) -> None:
        super().__init__(pair, shape, faces)
        self._h, self._u, self._rings, self._curves = h, u, faces, curves
        self._nodes, self._sides, self._r0 = curves.nodes, sides, r0
        self._rule = curves.rule(degree // 2 + 1, sides)
        self._normals = curves.cell_normals()
        self._half = np.full(len(r0), h / 2) if faces is None else faces.undeformed
        self._touched = np.unique(self._nodes[np.any(sides, axis=0)])
        self._far = h + (REACH - 1) * 2 * float(self._half[self._touched].max())
        self._around: Around | None = None
        if np.any(sides[0] & sides[1]):
            undeformed = np.column_stack([r0, self._half])
            nodal = undeformed[self._nodes]
            self._around = Around(self._x_of(undeformed), nodal, self._nodes, self._rule.cell)
        self._at = np.full_like(r0, np.nan)
        self._grown = 0.0
        self._places = nowhere()
        self._looked_at = Kept[tuple[Array, Faced]]()
        self._about: tuple[Faced, Array] | None = (
            None  # another scene's places, and their penetrations
        )
        self._close = Close(self._rule, self._nodes, sides, curves.element, self._around)

    # as a term

    def energy(self) -> float:
        """Of the whole shell."""
        at = self._pressed()
        return float(self._rule.weight[at.point] @ self._penalty(at)[0]) / 2

    def _add(self, b: Array, forces: Array) -> None:
        b[: forces.size] += forces.ravel()

    def _forces(self) -> Array:
        """The derivative (nodes, 2) by the places of all nodes, or with H (nodes, 3)."""
        at = self._pressed()
        weight = self._rule.weight[at.point] / 2 * self._penalty(at)[1]
        _, n, beta, nodes = self._geometry(at)
        forces = np.zeros((len(self._r0), 3 if self._faces else 2))
        np.add.at(forces, nodes, -weight[:, None, None] * slope_of(n, beta, forces.shape[1]))
        return forces

    def _by_parts(self) -> Entries:
        """Those of the second derivative by place and thickness."""
        return self._joined(*self._second(0.0), [0, 2])

    def _entries(self) -> Entries:
        entries = self._by_parts()
        return (
            self._faces.entries(self._at, entries, self._forces()[:, -1])
            if self._faces
            else entries
        )

    def _joined(self, H: Array, nodes: Longs, of_place: list[int]) -> Entries:
        """Blocks (n, dofs, dofs) by (U, V, W, H) at nodes (n, functions), of some of these and H,
        where it varies.
        """
        parts = [*of_place, 3] if self._faces else of_place
        which = np.flatnonzero(np.isin(np.arange(H.shape[1]) % 4, parts))
        dofs = unknowns(nodes, len(self._r0), len(parts), len(of_place))
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None])
        return rows.ravel(), columns.ravel(), H[:, which[:, None], which].ravel()

    @property
    def pattern_key(self) -> float:
        """See `NonlocalTerm`: a number of the cells that touch."""
        return float(crc32(self._touching_cells().tobytes()))

    def coupled_pairs(self) -> tuple[Longs, Longs]:
        """See `NonlocalTerm`: the nodes of cells that touch."""
        nodes = np.concatenate([self._nodes[cells] for cells in self._touching_cells().T], axis=1)
        return self._faces.coupled_pairs(*pairs_of(nodes)) if self._faces else pairs_of(nodes)

    def _touching_cells(self) -> Longs:
        both = [
            np.column_stack([self._rule.cell[at.point], at.cell])
            for at in of_each(self, self._pressed)
        ]
        return np.asarray(np.unique(np.concatenate(both), axis=0))

    def entries_of_waves(self, m: float) -> Entries:
        """The same of the second variation along waves, by the coefficients (U + V, V, W), as
        `shells.waves` has it.
        """
        rows, columns, values = self._joined(*self._second(m), [0, 1, 2])
        if self._rings:
            given = self._at, (rows, columns, values), self._forces()[:, -1]
            rows, columns, values = self._rings.waves(m).entries(*given)
        for _ in range(2):  # with P = U + V, U is P - V
            of_U = columns % 3 == 0
            values = np.concatenate([values, -values[of_U]])
            rows, columns = (
                np.concatenate([columns, columns[of_U] + 1]),
                np.concatenate([rows, rows[of_U]]),
            )
        return rows, columns, values / 2

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """Of thickness and placement; see `assembly.nonlocal_terms.FieldDifferentiable` and `by_fields`."""
        field = {"thickness": self._shape.thickness, "r0": self._shape.r0}.get(name)
        if field is None:
            return None
        weights = Weights(direction.x.array.reshape(-1, 2)[: len(self._r0)], energy, force)
        if name == "thickness":
            return field, by_factor(self._present(), weights)[..., None]
        return field, self._shape.shared(by_place(self._present(), weights))

    def _present(self) -> Present:
        at = self._pressed()
        each, one = np.arange(len(at.point)), np.ones(len(at.point))
        joined = Joined(each, each, at.distance, one, one == 0)
        of_all = (
            self._curves,
            self._r0,
            self._at,
            self._faces,
            self._rule,
            at,
            joined,
            self._penalty(at),
        )
        return PresentMeridian(
            *of_all, self._forces(), self._by_parts, self._entries, self._geometry
        )

    # what is seen

    def force(self) -> float:
        """The sum of the pressures over the contact, over E h R."""
        at = self._pressed()
        return float(self._rule.weight[at.point] @ self._penalty(at)[1]) / 2

    def least_gap(self) -> float:
        """Over R; nan where no places face each other within the reach."""
        u = self._now()
        x, (one, other) = (
            self._x_of(r := self._placed(u)),
            (np.unique(self._nodes[side]) for side in self._sides),
        )
        first, to_nodes = self._rule.first, self._far
        if not self._around:  # no place is farther than nodes
            ways = [x[first][:, None] - r[other], x[~first][:, None] - r[one]]
            to_nodes = min(float(distances(way).min()) for way in ways) * (1 + SAME)
        least = self._found(u, min(self._far, to_nodes)).distance.min(initial=np.inf)
        return float(least - self._h) if np.isfinite(least) else np.nan

    def penetration(self) -> float:
        """The largest, over R; 0 where nothing touches."""
        return float((self._h - self._pressed().distance).max(initial=0.0))

    def depth(self) -> float:
        """The same over the thickness there."""
        at, half = self._pressed(), self._half[self._nodes]
        here = np.sum(self._rule.shape[at.point] * half[self._rule.cell[at.point]], axis=1)
        there = np.sum(self._curves.table(0, at.X)[0] * half[at.cell], axis=1)
        return float(((self._h - at.distance) / (here + there)).max(initial=0.0))

    def held_gap(self, held: Longs, u: Array) -> float:
        """See `Facing.held_gap`."""
        if self._faces and not self._faces.constant:
            return np.inf
        one, other = self._sides

        def may(i: Longs, j: Longs) -> Inside:
            fits = one[i] & other[j] | other[i] & one[j]
            return np.asarray(fits & ~self._around.near(i, j) if self._around else fits)

        return between_held(held, self._nodes, self._r0, u, self._half, may)

    def refuse_overlap(self) -> None:
        """See that the shells do not overlap undeformed.

        Raises
        ------
        MeshError
            With the place.
        """
        at = self._found(0 * self._r0, self._h)
        deep = self._h - at.distance
        if len(deep) and deep.max() > WITHIN * self._h:
            rho, z = self._x_of(self._r0)[at.point[int(deep.argmax())]]
            where, by = f"{rho:.4g}, 0, {z:.4g}", deep.max() / self._h
            raise MeshError(
                f"contact: {self.pair.words} overlap undeformed, by {by:.4g} h at ({where}) R: move them apart"
            )

    def of_cells(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """The mean pressure over E h/R^2, the least gap over R within the reach, and which are
        pressed all over.

        Of all cells; see `Touching`.
        """
        at, count = self._pressed(), len(self._nodes)
        cell, weight = self._rule.cell, self._rule.weight
        area, size = np.bincount(cell, weight, count), weight[at.point] * self._penalty(at)[1]
        at_end, steep = self._at_ends(at)
        part = np.where(steep & ~at_end, 0.5, 1.0)
        force = np.bincount(cell[at.point], part * size, count) + np.bincount(
            at.cell, (1 - part) * size, count
        )
        gap = np.full(count, self._far - self._h)
        near = self._found(self._now(), self._far)
        np.minimum.at(gap, cell[near.point], near.distance - self._h)
        pressed = np.bincount(cell[np.unique(at.point)], weight[np.unique(at.point)], count)
        return (
            force / np.where(area > 0, area, 1.0),
            gap,
            (area > 0) & (pressed > EVERYWHERE * area),
        )

    def through(self, u: Array, v: Array) -> bool:
        """Whether points pass through a curve on the straight way between two displacements (nodes,
        2).

        Between two looks none moves, relative to another, by more than a part of the least
        thickness.
        """
        moved, least = (
            v - u,
            2 * min(float(self._half_at(each)[self._touched].min()) for each in (0 * u, u, v)),
        )
        moved = moved - [0.0, moved[:, 1].mean()]
        looks = int(np.ceil(2 * np.linalg.norm(moved, axis=1).max() / (PART * least)))
        ways = (u + k / looks * (v - u) for k in range(1, looks))
        return any(len(self._found(way, NEARER * least, faces=False).point) for way in ways)

    # in a step in time, see `in_steps.InSteps`

    passes = through

    @property
    def where(self) -> Array:
        """The displacement of all nodes."""
        return np.array(self._now())

    def along(self, moved: Array) -> Along:
        """See `InSteps`."""
        at = self._pressed()
        if self._faces:
            moved = np.column_stack([moved, self._faces.change(self._at, moved)])
        _, n, beta, nodes = self._geometry(at)
        moves = -np.einsum("nki,nki->n", slope_of(n, beta, moved.shape[1]), moved[nodes])
        deep, soft = self._h - at.distance, SOFT * self._h
        return Along.of(len(self._rule.weight), at.point, deep, moves, self.stiffness.value, soft)

    # geometry

    def _now(self) -> Array:
        return (
            self.look.u
            if self.look
            else np.asarray(self._u.x.array.reshape(-1, 2)[: len(self._r0)])
        )

    def _pressed(self) -> Faced:
        """The places that are pressed at the present state."""
        u, grown = self._now(), self._faces.value if self._faces else 0.0
        if self._about:
            self._at, at = np.array(u), self._about[0]
            return self._followed(at) if len(at.point) else at
        if grown != self._grown or not np.array_equal(u, self._at):
            self._at, self._places = self._looked_at.of(
                (u, grown), lambda: self._facing(np.array(u))
            )
            self._grown = grown
        return self._places

    def _facing(self, u: Array) -> tuple[Array, Faced]:
        at = self._found(u, self._h)
        return u, at.of(~self._left_to_edges(at))

    def _penalty(self, at: Faced) -> tuple[Array, Array, Array]:
        if self._about:
            given = self._h - at.distance, self._about[1], self.stiffness.value, SOFT * self._h
            return expanded(*given, bends=self.held is not None)
        pressed = penalty(self._h - at.distance, self.stiffness.value, SOFT * self._h)
        return self.look.of(at.point, pressed) if self.look else pressed

    def pressed(self) -> tuple[Faced, Array]:
        """The places that are pressed at the present state, and their penetrations."""
        at = self._pressed()
        return at, self._h - at.distance

    def expand_about(self, pressed: tuple[Faced, Array]) -> None:
        """Take for good what is pressed in another scene on the same mesh, see `expanded`."""
        self._about = pressed

    def _followed(self, at: Faced) -> Faced:
        """Places after a small change, free ones also beyond an end of their cells."""
        r, X = self._placed(self._at), at.X
        x, nodal = self._x_of(r)[at.point], r[self._nodes[at.cell]]
        for _ in range(FOLLOWING):
            pull, bent, _ = slopes(x, self._curves.jets(X, nodal))
            X = X + np.where(at.free, pull / np.where(at.free, bent, 1.0), 0.0)
        return replace(at, X=X, distance=distances(x - self._curves.jets(X, nodal)[0]))

    def _placed(self, u: Array, *, faces: bool = True) -> Array:
        """All nodes (nodes, 3), with half the thickness less h/2, or nothing, as the third
        component.
        """
        return np.column_stack([self._r0 + u, (self._half_at(u) - self._h / 2) * faces])

    def _half_at(self, u: Array) -> Array:
        return self._faces.half(u) if self._faces else self._half

    def _x_of(self, r: Array) -> Array:
        """The points, with the third component of the other sign, see `distances`."""
        nodal = r[self._nodes[self._rule.cell]] * SIGNS[: r.shape[1]]
        return np.asarray(np.einsum("nk,nki->ni", self._rule.shape, nodal))

    def _found(self, u: Array, of_faces: float, *, faces: bool = True) -> Faced:
        """The places that points face within a distance of faces or mid-surfaces at a displacement: one on each side of
        a point at most."""
        r = self._placed(u, faces=faces)
        x, nodal = self._x_of(r), r[self._nodes]
        thicker = highest(nodal[..., 2], self._curves.lebesgue)
        point, cell = self._close(x[:, :2], nodal[..., :2], of_faces + 2 * thicker)
        if not len(point):
            return nowhere()
        at = self._curves.projected(x, nodal, point, cell)
        return self._curves.nearest(at.of(at.distance < of_faces), x, nodal, self._around)

    def _left_to_edges(self, at: Faced) -> Inside:
        """Which places do not count: those of points inside a shell that face the end of another
        one, steeply.

        The end's own point is there too; see `facing.Facing.left_to_edges`. Normals are undeformed
        ones, so that the energy is a function of the state.
        """
        at_end, steep = self._at_ends(at)
        return np.asarray(at_end & steep & ~self._rule.on_edge[at.point])

    def _at_ends(self, at: Faced) -> tuple[Inside, Inside]:
        """Which places are at a free end, and which are in a cell that is steep to their point's."""
        end = (at.X == 1.0).astype(np.int64)
        at_end = ~at.free & (self._curves.beside[at.cell, end] < 0)
        level = np.abs(np.sum(self._rule.normal[at.point] * self._normals[at.cell], axis=1))
        return np.asarray(at_end), np.asarray(level < STEEP)

    def _geometry(self, at: Faced) -> tuple[Array, Array, Array, Longs]:
        """Distances, normals, and beta (n, functions of both cells) with its nodes."""
        nodes = np.concatenate(
            [self._nodes[self._rule.cell[at.point]], self._nodes[at.cell]], axis=1
        )
        r = self._r0 + self._at
        N, shape = self._rule.shape[at.point], self._curves.table(0, at.X)[0]
        beta = np.concatenate([N, -shape], axis=1)
        off = np.einsum("nk,nki->ni", beta, r[nodes])
        d = np.linalg.norm(off, axis=1)
        return d, off / d[:, None], beta, nodes

    def _second(self, m: float) -> tuple[Array, Longs]:
        """(n, dofs, dofs) by (U, V, W, H) at the nodes of both cells, over the whole circumference."""
        at = self._pressed()
        _, first, second = self._penalty(at)
        d, n, beta, nodes = self._geometry(at)
        off, (count, functions) = d[:, None] * n, beta.shape
        half, weight, r = functions // 2, self._rule.weight[at.point] / 2, self._placed(self._at)
        jets, (shape, along) = (
            self._curves.jets(at.X, r[self._nodes[at.cell]]),
            self._curves.table(1, at.X),
        )
        A = slopes(self._x_of(r)[at.point], jets)[1]
        y, across = jets[0], jets[1, :, :2] - np.sum(jets[1, :, :2] * n, axis=1)[:, None] * n
        rows = np.zeros((4, *beta.shape, 4))
        normal, way, slide, turn = rows
        normal[..., IN_PLANE] = way[..., IN_PLANE] = beta[..., None] * n[:, None]
        normal[..., 3] = np.concatenate([-beta[:, :half], beta[:, half:]], axis=1)
        slide[..., IN_PLANE] = -beta[..., None] * across[:, None]
        slide[:, half:, IN_PLANE] -= along[..., None] * off[:, None]
        slide[:, half:, 3] -= along * d[:, None]
        turn[..., 1] = -beta * y[:, :1]
        turn[:, half:, 0] += m * off[:, :1] * shape
        turn[:, half:, 1] += off[:, :1] * shape
        turn[:, half:, 2] += m * off[:, 1:] * shape
        turn[:, half:, 3] += m * d[:, None] * shape
        B, bent = y[:, 0] * (y[:, 0] + off[:, 0]), -weight * first / d
        inverse = [
            np.where(can, 1 / np.where(can, each, 1.0), 0.0)
            for can, each in ((at.free, A), (B > 0, B))
        ]
        flat = rows.reshape(4, count, 4 * functions).swapaxes(0, 1)
        factors = np.column_stack([weight * second, -bent, -bent * inverse[0], -bent * inverse[1]])
        H = flat.transpose(0, 2, 1) @ (factors[..., None] * flat)
        both = bent[:, None, None] * beta[:, :, None] * beta[:, None]
        for i in range(3):
            H[:, i::4, i::4] += both
        return H, nodes


class PresentMeridian(Present):
    """A contact on a meridian at a state."""

    def of_weights(self, tables: Array, places: Array) -> Array:
        slopes = (
            tables[1][..., None] * (places[1] / np.sum(places[1] ** 2, axis=1)[:, None])[:, None]
        )
        slopes[..., 0] += tables[0] / places[0, :, :1]
        return np.asarray(slopes)


def touchings(
    pairs: Sequence[Pair],
    r0: fem.Function,
    u: fem.Function,
    patches: Mapping[str, Inside],
    h: float,
    degree: int,
    thickness: fem.Function | None = None,
    thins: Array | int = 0,
    natural: Grown | None = None,
) -> list[MeridianTouching]:
    """The contacts of pairs; of what they are made of see `building.touchings`.

    Raises
    ------
    MeshError
        If shells of a pair overlap undeformed.
    """
    V, made, placed = (
        r0.function_space,
        list[MeridianTouching](),
        np.array(r0.x.array.reshape(-1, 2)),
    )
    element, nodes = V.element.basix_element, V.dofmap.list.astype(np.int64)
    curves, named = (
        Curves(element, nodes, placed, h),
        {WHOLE: np.ones(len(nodes), dtype=bool), **patches},
    )
    thinning, times, faces = (
        np.broadcast_to(np.asarray(thins) > 0, (len(nodes), 1))[:, 0],
        np.ones(nodes.shape),
        None,
    )
    if thickness is not None:
        times = thickness.x.array[thickness.function_space.dofmap.list]
    if thickness is not None or thinning.any():
        faces = Rings(curves, placed, h, np.array([times]), thinning)
        if natural and natural.stretch is not None:
            rates = natural.volumes(faces.tangents(), element.points)
            rates[:, ~thinning] = np.eye(4)[0][:, None, None]
            faces = Rings(curves, placed, h, times * rates, thinning, natural.stretch)
    shape = Shape(r0, thickness, nodes, slice(None))
    for pair in pairs:
        one, other = (named[name] for name in pair.names)
        made.append(
            MeridianTouching(pair, curves, placed, u, (one, other), h, degree, shape, faces)
        )
        made[-1].refuse_overlap()
    return made
