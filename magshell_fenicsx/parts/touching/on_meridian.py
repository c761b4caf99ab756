"""Contact of shells with one axis on their meridians: the same penalty of the same gap as `touching`, for curves.

A point x of one curve has the nearest place y of the other. Both curves have points, so that each has half of the
penalty. With d = |x - y|, n = (x - y)/d, F = d^2/2, A = F,ss = |y'|^2 - (x - y) . y'' and changes D = dx - dy:

    d,uu = [D . D - (n . D)^2 - C_s^2/A - C_theta^2/B]/d,   C_s = -D . y' - (x - y) . dy',   B = rho_x rho_y

Where the thickness varies d is the least of |x - y| - H(y), less H(x), plus h, with half the thickness H. Then n . y'
is -H', C_s has y' less its part along n, and A is |y'|^2 - (x - y) . y'' - H'^2 - |x - y| H''. H less h/2 is a third
component of places.

Along e_theta the nearest place moves as it does along the curve. A wave (U cos, V sin, W cos) of m theta moves it by
C_theta = -rho_y D_V + (x - y)_rho (m U_y + V_y) + (x - y)_z m W_y; without waves it stays. The points are those of a
rule on each cell. At a free end one is next to the end, which an edge stands on.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from zlib import crc32

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.coupled import Entries, pairs_of
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.parts.gap import SOFT, expanded, penalty
from magshell_fenicsx.parts.touching.building import WITHIN
from magshell_fenicsx.parts.touching.curves import SAME, SIGNS, Close, Curves, Faced, distances, nowhere, slopes
from magshell_fenicsx.parts.touching.facing import STEEP
from magshell_fenicsx.parts.touching.in_steps import Along, ContactTerm, Kept, of_each
from magshell_fenicsx.parts.touching.nearest import FOLLOWING, highest
from magshell_fenicsx.parts.touching.section import Pair
from magshell_fenicsx.parts.touching.touching import NEARER, PART, REACH

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Inside = NDArray[np.bool_]


class MeridianTouching(ContactTerm):
    """The energy of the contact of a pair on the meridian; an `assembly.terms.Term` and `assembly.coupled.Coupled`.

    Parameters
    ----------
    sides
        Whether each cell belongs to the first shell, and to the second.
    h
        Thickness over R: that of the penalty and of the search where it varies.
    degree
        Of the quadrature.
    thickness
        What multiplies h, (1,); None for 1.
    """

    def __init__(
        self,
        pair: Pair,
        r0: fem.Function,
        u: fem.Function,
        sides: tuple[Inside, Inside],
        h: float,
        degree: int,
        thickness: fem.Function | None = None,
    ) -> None:
        super().__init__(pair)
        self._h, self._u, self._placement, self._thickness = h, u, r0, thickness
        V = r0.function_space
        self._nodes = V.dofmap.list.astype(np.int64)
        self._sides, self._r0 = sides, np.array(r0.x.array.reshape(-1, 2))
        self._curves = Curves(V.element.basix_element, self._nodes, self._r0, h)
        self._rule = self._curves.rule(degree // 2 + 1, sides)
        self._normals = self._curves.cell_normals()
        self._half = h / 2 * (np.ones(len(self._r0)) if thickness is None else self._curves.at_nodes(thickness))
        of_both = self._half[self._nodes[np.any(sides, axis=0)]]
        self._thinnest, self._far = 2 * float(of_both.min()), h + (REACH - 1) * 2 * float(of_both.max())
        self._at: Array = np.full_like(self._r0, np.nan)
        self._places = nowhere()
        self._looked_at = Kept[tuple[Array, Faced]]()
        self._about: tuple[Faced, Array] | None = None  # another scene's places, and their penetrations
        self._close = Close(self._rule, self._nodes, sides, V.element.basix_element)

    # as a term

    def energy(self) -> float:
        """Of the whole shell."""
        at = self._pressed()
        return float(self._rule.weight[at.point] @ self._penalty(at)[0]) / 2

    def add_residual(self, b: Array, factor: float) -> None:
        forces = np.sum(of_each(self, self._forces), axis=0)
        b[: forces.size] += factor * forces.ravel()

    def _forces(self) -> Array:
        at = self._pressed()
        weight = self._rule.weight[at.point] / 2 * self._penalty(at)[1]
        _, n, beta, nodes = self._geometry(at)
        forces = np.zeros_like(self._r0)
        np.add.at(forces, nodes, -(weight[:, None] * beta)[..., None] * n[:, None])
        return forces

    def _entries(self) -> Entries:
        H, nodes = self._second(0.0)
        of_plane = np.flatnonzero(np.arange(H.shape[1]) % 3 != 1)
        return _entries(H[:, of_plane[:, None], of_plane], nodes, 2)

    @property
    def since(self) -> float:
        """See `Coupled`: a number of the cells that touch."""
        return float(crc32(self._touching_cells().tobytes()))

    def around(self) -> tuple[Longs, Longs]:
        """See `Coupled`: the nodes of cells that touch."""
        return pairs_of(np.concatenate([self._nodes[cells] for cells in self._touching_cells().T], axis=1))

    def _touching_cells(self) -> Longs:
        both = [np.column_stack([self._rule.cell[at.point], at.cell]) for at in of_each(self, self._pressed)]
        return np.asarray(np.unique(np.concatenate(both), axis=0))

    def entries_of_waves(self, m: float) -> Entries:
        """The same of the second variation along waves, by the coefficients (U + V, V, W), as `shells.waves` has it."""
        H, nodes = self._second(m)
        H[:, 1::3] -= H[:, ::3]  # with P = U + V, U is P - V
        H[..., 1::3] -= H[..., ::3]
        return _entries(H / 2, nodes, 3)

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """Of thickness and placement; see `assembly.coupled.KnowsFields` and `by_fields`."""
        field = {"thickness": self._thickness, "r0": self._placement}.get(name)
        if field is None:
            return None
        w = direction.x.array.reshape(-1, 2)[: len(self._r0)]
        by_half = self._by_half(w, energy, force)[self._nodes]
        speeds, lengths = self._curves.speeds(), self._curves.lengths[self._nodes]
        if name == "thickness":
            return field, (by_half * self._h / 2 * speeds / lengths)[..., None]
        rows, columns, values = self._entries()
        stiff = np.bincount(rows, values * w.ravel()[columns], w.size).reshape(-1, 2)
        nodal = energy * self._forces() + force * stiff + self._by_weights(w, energy, force)
        if self._thickness is not None:
            t = self._thickness.x.array[self._thickness.function_space.dofmap.list]
            by_speed = by_half * (self._h / 2 * t - self._half[self._nodes]) / lengths
            np.add.at(nodal, self._nodes, np.einsum("cq,cqki->cki", by_speed, self._curves.by_speed()))
        count = np.bincount(self._nodes.ravel(), minlength=len(nodal))
        return field, np.asarray((nodal / count[:, None])[self._nodes])

    def _by_half(self, w: Array, energy: float, force: float) -> Array:
        """By half the thickness at nodes (nodes,), of energy Pi + force w . Pi,u."""
        at, by_half = self._pressed(), np.zeros(len(self._r0))
        _, first, second = self._penalty(at)
        off, n, beta, nodes = self._geometry(at)
        count, functions = beta.shape
        half, weight = functions // 2, self._rule.weight[at.point] / 2
        normal, slide, A = self._rows(at, off, n, beta)
        along = np.insert(w, 1, 0.0, axis=1)[nodes].reshape(count, -1)
        farther, slid = (np.sum(row.reshape(count, -1) * along, axis=1) for row in (normal, slide))
        thicker = np.concatenate([beta[:, :half], -beta[:, half:]], axis=1)
        forces = (weight * (energy * first - force * second * farther))[:, None] * thicker
        turned = np.where(at.free, slid / np.where(at.free, A, 1.0), 0.0)
        forces[:, half:] -= (force * weight * first * turned)[:, None] * self._curves.table(1, at.X)[1]
        np.add.at(by_half, nodes, forces)
        return by_half

    def _by_weights(self, w: Array, energy: float, force: float) -> Array:
        """By the undeformed places of nodes (nodes, 2), as far as the weights of points depend on them."""
        at, nodal = self._pressed(), np.zeros_like(self._r0)
        value, first, _ = self._penalty(at)
        _, n, beta, nodes = self._geometry(at)
        farther = np.einsum("nk,ni,nki->n", beta, n, w[nodes])
        per_weight = self._rule.weight[at.point] / 2 * (energy * value - force * first * farther)
        own = self._nodes[self._rule.cell[at.point]]
        shape, slope = self._curves.table(1, self._rule.shape[at.point] @ self._curves.element.points.ravel())
        (rho, _), tangent = (np.einsum("nk,nki->in", table, self._r0[own]) for table in (shape, slope))
        forces = slope[..., None] * (tangent / np.sum(tangent * tangent, axis=0)).T[:, None]
        forces[..., 0] += shape / rho[:, None]
        np.add.at(nodal, own, per_weight[:, None, None] * forces)
        return nodal

    # what is seen

    def force(self) -> float:
        """The sum of the pressures over the contact, over E h R."""
        at = self._pressed()
        return float(self._rule.weight[at.point] @ self._penalty(at)[1]) / 2

    def least_gap(self) -> float:
        """Over R; nan where no places face each other within the reach."""
        u = self._now()
        x, (one, other) = self._x_of(r := self._placed(u)), (np.unique(self._nodes[side]) for side in self._sides)
        first = self._rule.first
        ways = [x[first][:, None] - r[other], x[~first][:, None] - r[one]]
        to_nodes = min(float(distances(way).min()) for way in ways)  # no place is farther
        least = self._found(u, min(self._far, to_nodes * (1 + SAME))).distance.min(initial=np.inf)
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
        one, other = (np.intersect1d(held, self._nodes[side]) for side in self._sides)
        r, half = self._r0 + u, self._half
        away = np.linalg.norm(r[one][:, None] - r[other], axis=2) - half[one][:, None] - half[other]
        return float(away.min(initial=np.inf))

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

    def of_cells(self) -> tuple[Array, Array]:
        """The mean pressure over E h/R^2, and the least gap over R within the reach, of all cells."""
        at, count = self._pressed(), len(self._nodes)
        cell, weight = self._rule.cell, self._rule.weight
        area = np.bincount(cell, weight, count)
        force = np.bincount(cell[at.point], weight[at.point] * self._penalty(at)[1], count)
        gap = np.full(count, self._far - self._h)
        near = self._found(self._now(), self._far)
        np.minimum.at(gap, cell[near.point], near.distance - self._h)
        return force / np.where(area > 0, area, 1.0), gap

    def through(self, u: Array, v: Array) -> bool:
        """Whether points pass through a curve on the straight way between two displacements (nodes, 2).

        Between two looks none moves, relative to another, by more than a part of the least thickness.
        """
        moved, least = v - u, self._thinnest
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
        _, n, beta, nodes = self._geometry(at)
        moves = -np.einsum("nk,ni,nki->n", beta, n, moved[nodes])
        deep, soft = self._h - at.distance, SOFT * self._h
        return Along.of(len(self._rule.weight), at.point, deep, moves, self.stiffness.value, soft)

    # geometry

    def _now(self) -> Array:
        return self.look.u if self.look else np.asarray(self._u.x.array.reshape(-1, 2)[: len(self._r0)])

    def _pressed(self) -> Faced:
        """The places that are pressed at the present state."""
        u = self._now()
        if self._about:
            self._at, at = np.array(u), self._about[0]
            return self._followed(at) if len(at.point) else at
        if not np.array_equal(u, self._at):
            self._at, self._places = self._looked_at.of((u,), lambda: self._facing(np.array(u)))
        return self._places

    def _facing(self, u: Array) -> tuple[Array, Faced]:
        at = self._found(u, self._h)
        return u, at.of(~self._left_to_edges(at))

    def _penalty(self, at: Faced) -> tuple[Array, Array, Array]:
        if self._about:
            return expanded(self._h - at.distance, self._about[1], self.stiffness.value, SOFT * self._h)
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
        """All nodes (nodes, 3), with half the thickness less h/2, or nothing, as the third component."""
        return np.column_stack([self._r0 + u, (self._half - self._h / 2) * faces])

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
        return self._curves.nearest(at.of(at.distance < of_faces), x, nodal)

    def _left_to_edges(self, at: Faced) -> Inside:
        """Which places do not count: those of points inside a shell that face the end of another one, steeply.

        The end's own point is there too; see `facing.Facing.left_to_edges`. Normals are undeformed ones, so that the
        energy is a function of the state.
        """
        end = (at.X == 1.0).astype(np.int64)
        at_end = ~at.free & (self._curves.beside[at.cell, end] < 0)
        level = np.abs(np.sum(self._rule.normal[at.point] * self._normals[at.cell], axis=1))
        return np.asarray(at_end & (level < STEEP) & ~self._rule.on_edge[at.point])

    def _geometry(self, at: Faced) -> tuple[Array, Array, Array, Longs]:
        """x - y, n, and beta (n, functions of both cells) with its nodes."""
        nodes = np.concatenate([self._nodes[self._rule.cell[at.point]], self._nodes[at.cell]], axis=1)
        r = self._r0 + self._at
        N, shape = self._rule.shape[at.point], self._curves.table(0, at.X)[0]
        beta = np.concatenate([N, -shape], axis=1)
        off = np.einsum("nk,nki->ni", beta, r[nodes])
        return off, off / np.linalg.norm(off, axis=1)[:, None], beta, nodes

    def _rows(self, at: Faced, off: Array, n: Array, beta: Array) -> tuple[Array, Array, Array]:
        """By (U, V, W) at the nodes of both cells, (n, functions, 3): d,u, and C_s; and A (n,)."""
        r = self._placed(self._at)
        jets, half = self._curves.jets(at.X, r[self._nodes[at.cell]]), beta.shape[1] // 2
        along = jets[1, :, :2] - np.sum(jets[1, :, :2] * n, axis=1)[:, None] * n
        normal, slide = np.zeros((2, *beta.shape, 3))
        normal[..., ::2] = beta[..., None] * n[:, None]
        slide[..., ::2] = -beta[..., None] * along[:, None]
        slide[:, half:, ::2] -= self._curves.table(1, at.X)[1][..., None] * off[:, None]
        return normal, slide, slopes(self._x_of(r)[at.point], jets)[1]

    def _second(self, m: float) -> tuple[Array, Longs]:
        """(n, dofs, dofs) by (U, V, W) at the nodes of both cells, over the whole circumference."""
        at = self._pressed()
        _, first, second = self._penalty(at)
        off, n, beta, nodes = self._geometry(at)
        count, functions = beta.shape
        half, d = functions // 2, np.linalg.norm(off, axis=1)
        weight = self._rule.weight[at.point] / 2
        bent = -weight * first / d
        normal, slide, A = self._rows(at, off, n, beta)
        y = self._curves.jets(at.X, (self._r0 + self._at)[self._nodes[at.cell]])[0]
        turn = np.zeros((count, functions, 3))
        turn[..., 1] = -beta * y[:, :1]
        shape = -beta[:, half:]
        turn[:, half:, 0] += m * off[:, :1] * shape
        turn[:, half:, 1] += off[:, :1] * shape
        turn[:, half:, 2] += m * off[:, 1:] * shape
        B = y[:, 0] * (y[:, 0] + off[:, 0])
        inverse = [np.where(can, 1 / np.where(can, each, 1.0), 0.0) for can, each in ((at.free, A), (B > 0, B))]
        rows = np.stack([each.reshape(count, 3 * functions) for each in (normal, slide, turn)], axis=1)
        factors = np.column_stack([weight * second - bent, -bent * inverse[0], -bent * inverse[1]])
        H = rows.transpose(0, 2, 1) @ (factors[..., None] * rows)
        both = bent[:, None, None] * beta[:, :, None] * beta[:, None]
        for i in range(3):
            H[:, i::3, i::3] += both
        return H, nodes


def touchings(
    pairs: Sequence[Pair],
    r0: fem.Function,
    u: fem.Function,
    patches: Mapping[str, Inside],
    h: float,
    degree: int,
    thickness: fem.Function | None = None,
) -> list[MeridianTouching]:
    """The contacts of pairs of shells; of `thickness` see `MeridianTouching`.

    Raises
    ------
    MeshError
        If a pair overlaps undeformed.
    """
    made = list[MeridianTouching]()
    for pair in pairs:
        one, other = (patches[name] for name in pair.names)
        made.append(MeridianTouching(pair, r0, u, (one, other), h, degree, thickness))
        made[-1].refuse_overlap()
    return made


def _entries(H: Array, nodes: Longs, size: int) -> Entries:
    """Blocks (n, dofs, dofs) by the unknowns at nodes (n, functions), `size` at each."""
    dofs = (size * nodes[..., None] + np.arange(size)).reshape(len(nodes), size * nodes.shape[1])
    rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None])
    return rows.ravel(), columns.ravel(), H.ravel()
