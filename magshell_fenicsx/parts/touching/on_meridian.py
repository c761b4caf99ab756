"""Contact of shells with one axis on their meridians: the same penalty of the same gap as `touching`, for curves.

A point x of one curve has the nearest place y of the other. Both curves have points, so that each has half of the
penalty. With d = |x - y|, n = (x - y)/d, F = d^2/2, A = F,ss = |y'|^2 - (x - y) . y'' and changes D = dx - dy:

    d,uu = [D . D - (n . D)^2 - C_s^2/A - C_theta^2/B]/d,   C_s = -D . y' - (x - y) . dy',   B = rho_x rho_y

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
from magshell_fenicsx.parts.touching.curves import Faced, Rule, beside, nowhere
from magshell_fenicsx.parts.touching.facing import ALIKE, STEEP
from magshell_fenicsx.parts.touching.in_steps import Along, ContactTerm, Kept, of_each
from magshell_fenicsx.parts.touching.nearest import BULGE, FOLLOWING
from magshell_fenicsx.parts.touching.rules import BEFORE, rule_on_line
from magshell_fenicsx.parts.touching.section import Pair
from magshell_fenicsx.parts.touching.touching import NEARER, PART, REACH

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
Inside = NDArray[np.bool_]
START = 4  # parts of a cell, from whose ends the search for the nearest place begins, for each degree
ROUNDS, EXACT = 30, 1e-10  # Newton's steps at most; after a smaller one, in the cell, the place is exact
FLAT = 1e-3  # of the square of the speed: below it the step takes that
SAME = 1e-9  # of h: places of two cells at the same distance are one


class MeridianTouching(ContactTerm):
    """The energy of the contact of a pair on the meridian; an `assembly.terms.Term` and `assembly.coupled.Coupled`.

    Parameters
    ----------
    sides
        Whether each cell belongs to the first shell, and to the second.
    degree
        Of the quadrature.
    """

    def __init__(
        self, pair: Pair, r0: fem.Function, u: fem.Function, sides: tuple[Inside, Inside], h: float, degree: int
    ) -> None:
        super().__init__(pair)
        self._h, self._u = pair.thickness * h, u
        V = r0.function_space
        self._nodes = V.dofmap.list.astype(np.int64)
        self._element, self._r0 = V.element.basix_element, np.array(r0.x.array.reshape(-1, 2))
        self._sides, self._beside = sides, beside(self._nodes)
        self._rule = self._points(degree // 2 + 1)
        self._normals = self._cell_normals()
        self._at: Array = np.full_like(self._r0, np.nan)
        self._places = nowhere()
        self._looked_at = Kept[tuple[Array, Faced]]()
        self._about: tuple[Faced, Array] | None = None  # another scene's places, and their penetrations
        k = self._element.degree
        self._start = np.linspace(0.0, 1.0, START * k + 1, dtype=np.float64)

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
        at = self._pressed()
        return np.unique(np.column_stack([self._rule.cell[at.point], at.cell]), axis=0)

    def entries_of_waves(self, m: float) -> Entries:
        """The same of the second variation along waves, by the coefficients (U + V, V, W), as `shells.waves` has it."""
        H, nodes = self._second(m)
        H[:, 1::3] -= H[:, ::3]  # with P = U + V, U is P - V
        H[..., 1::3] -= H[..., ::3]
        return _entries(H / 2, nodes, 3)

    # what is seen

    def force(self) -> float:
        """The sum of the pressures over the contact, over E h R."""
        at = self._pressed()
        return float(self._rule.weight[at.point] @ self._penalty(at)[1]) / 2

    def least_gap(self) -> float:
        """Over R; nan where no places face each other within the reach."""
        least = self._found(self._now(), REACH * self._h).distance.min(initial=np.inf)
        return float(least - self._h) if np.isfinite(least) else np.nan

    def penetration(self) -> float:
        """The largest, over R; 0 where nothing touches."""
        return float((self._h - self._pressed().distance).max(initial=0.0))

    def refuse_overlap(self, h: float) -> None:
        """See that the shells do not overlap undeformed; `h` is that of the first one.

        Raises
        ------
        MeshError
            With the place.
        """
        at = self._found(0 * self._r0, self._h)
        deep = self._h - at.distance
        if len(deep) and deep.max() > WITHIN * self._h:
            rho, z = self._x_of(self._r0)[at.point[int(deep.argmax())]]
            where, by = f"{rho:.4g}, 0, {z:.4g}", deep.max() / h
            raise MeshError(
                f"contact: {self.pair.words} overlap undeformed, by {by:.4g} h at ({where}) R: move them apart"
            )

    def of_cells(self) -> tuple[Array, Array]:
        """The mean pressure over E h/R^2, and the least gap over R within the reach, of all cells."""
        at, count = self._pressed(), len(self._nodes)
        cell, weight = self._rule.cell, self._rule.weight
        area = np.bincount(cell, weight, count)
        force = np.bincount(cell[at.point], weight[at.point] * self._penalty(at)[1], count)
        gap = np.full(count, (REACH - 1) * self._h)
        near = self._found(self._now(), REACH * self._h)
        np.minimum.at(gap, cell[near.point], near.distance - self._h)
        return force / np.where(area > 0, area, 1.0), gap

    def through(self, u: Array, v: Array) -> bool:
        """Whether points pass through a curve on the straight way between two displacements (nodes, 2).

        Between two looks none moves, relative to another, by more than a part of the thickness.
        """
        moved = v - u
        moved = moved - [0.0, moved[:, 1].mean()]
        looks = int(np.ceil(2 * np.linalg.norm(moved, axis=1).max() / (PART * self._h)))
        return any(len(self._found(u + k / looks * (v - u), NEARER * self._h).point) for k in range(1, looks))

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
        r, X = self._r0 + self._at, at.X
        x, nodal = self._x_of(r)[at.point], r[self._nodes[at.cell]]
        for _ in range(FOLLOWING):
            y, first, second = self._jets(X, nodal)
            off = x - y
            bent = np.sum(first * first - off * second, axis=1)
            X = X + np.where(at.free, np.sum(off * first, axis=1) / np.where(at.free, bent, 1.0), 0.0)
        return replace(at, X=X, distance=np.linalg.norm(x - self._jets(X, nodal)[0], axis=1))

    def _points(self, count: int) -> Rule:
        """So many Gauss's points in each cell, in those with a free end the end among them."""
        ends = (self._beside < 0) & (np.abs(self._r0[self._nodes[:, :2], 0]) > SAME)
        parts = list[tuple[Longs, Array, Array, Inside, Array, Inside]]()
        for begins, last in ((False, False), (True, False), (False, True), (True, True)):
            cells = np.flatnonzero(np.any(self._sides, axis=0) & (ends == [begins, last]).all(axis=1))
            X, w = rule_on_line(count, begins, last)
            table = self._table(1, X)
            x, along = np.einsum("dqk,cki->dcqi", table, self._r0[self._nodes[cells]])
            speed = np.linalg.norm(along, axis=2)
            area = 2 * np.pi * x[..., 0] * speed * w
            normal = np.stack([-along[..., 1], along[..., 0]], axis=-1) / speed[..., None]
            on_edge = np.tile((X < 2 * BEFORE) & begins | (X > 1 - 2 * BEFORE) & last, len(cells))
            cell, shape = np.repeat(cells, len(X)), np.tile(table[0], (len(cells), 1))
            parts.append((cell, shape, area.ravel(), self._sides[0][cell], normal.reshape(-1, 2), on_edge))
        return Rule(*(np.concatenate(each) for each in zip(*parts, strict=True)))

    def _cell_normals(self) -> Array:
        """(cells, 2) undeformed, of the straight lines between the ends."""
        a, b = self._r0[self._nodes[:, 0]], self._r0[self._nodes[:, 1]]
        n = np.column_stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]])
        return np.asarray(n / np.linalg.norm(n, axis=1)[:, None])

    def _x_of(self, r: Array) -> Array:
        return np.asarray(np.einsum("nk,nki->ni", self._rule.shape, r[self._nodes[self._rule.cell]]))

    def _found(self, u: Array, reach: float) -> Faced:
        """The places that points face within a distance at a displacement: one on each side of a point at most."""
        r, rule = self._r0 + u, self._rule
        x, nodal = self._x_of(r), r[self._nodes]
        centres = nodal.mean(axis=1)
        radii = BULGE * np.linalg.norm(nodal - centres[:, None], axis=2).max(axis=1)
        parts = list[tuple[Longs, Longs]]()
        for mine, others in zip((rule.first, ~rule.first), self._sides[::-1], strict=True):
            near, cells = np.unique(rule.cell[mine]), np.flatnonzero(others)
            far = np.linalg.norm(centres[near][:, None] - centres[cells], axis=2) - radii[cells] - reach
            within = np.zeros(len(nodal), dtype=bool)
            within[near] = (far < radii[near][:, None]).any(axis=1)
            points, cells = np.flatnonzero(mine & within[rule.cell]), cells[(far < radii[near][:, None]).any(axis=0)]
            away = np.linalg.norm(x[points][:, None] - centres[cells], axis=2)
            i, j = np.nonzero(away < radii[cells] + reach)
            parts.append((points[i], cells[j]))
        point, cell = (np.concatenate(each) for each in zip(*parts, strict=True))
        if not len(point):
            return nowhere()
        at = self._projected(x, nodal, point, cell)
        return self._nearest(at.of(at.distance < reach), x, nodal)

    def _projected(self, x: Array, nodal: Array, point: Longs, cell: Longs) -> Faced:
        """The nearest place of each cell, by Newton's method from the nearest of some."""
        shape = self._table(0, self._start)[0]
        off = x[point][:, None] - np.einsum("mk,nki->nmi", shape, nodal[cell])
        X = self._start[np.einsum("nmi,nmi->nm", off, off).argmin(axis=1)]
        for _ in range(ROUNDS):
            y, first, second = self._jets(X, nodal[cell])
            off, speed = x[point] - y, np.sum(first * first, axis=1)
            bent = speed - np.sum(off * second, axis=1)
            step = np.sum(off * first, axis=1) / np.where(bent > FLAT * speed, bent, speed)
            after = np.clip(X + np.clip(step, -0.25, 0.25), 0.0, 1.0)
            moved, X = np.abs(after - X).max(initial=0.0), after
            if moved < EXACT:
                break
        y, first, _ = self._jets(X, nodal[cell])
        off = x[point] - y
        pull = np.sum(off * first, axis=1)
        free = ~((X == 0.0) & (pull <= 0) | (X == 1.0) & (pull >= 0))
        return Faced(point, cell, X, free, np.linalg.norm(off, axis=1))

    def _nearest(self, at: Faced, x: Array, nodal: Array) -> Faced:
        """Of all places those from which the curve goes on to no nearer one, one on each side of a point."""
        number = len(self._nodes)
        order = np.argsort(at.point * number + at.cell)
        at = at.of(order)
        keys = at.point * number + at.cell
        stays = np.ones(len(keys), dtype=bool)
        for end, X in enumerate((0.0, 1.0)):
            beyond = self._beside[at.cell, end]
            there = np.minimum(np.searchsorted(keys, at.point * number + beyond), max(len(keys) - 1, 0))
            listed = keys[there] == at.point * number + beyond
            nearer = listed & (at.distance[there] < at.distance - SAME * self._h)
            stays &= ~((at.X == X) & (beyond >= 0)) | (listed & ~nearer)
        at = at.of(stays)
        at = at.of(np.lexsort((at.distance, at.point)))
        if not len(at.point):
            return at
        way = x[at.point] - self._jets(at.X, nodal[at.cell])[0]
        way = way / np.maximum(np.linalg.norm(way, axis=1), 1e-300)[:, None]
        begins = np.flatnonzero(np.diff(at.point, prepend=-1))
        first = np.repeat(begins, np.diff([*begins, len(way)]))
        behind = np.sum(way * way[first], axis=1) < ALIKE
        chosen = np.zeros(len(way), dtype=bool)
        chosen[begins] = True
        others = np.flatnonzero(behind)
        chosen[others[np.flatnonzero(np.diff(at.point[others], prepend=-1))]] = True
        return at.of(chosen)

    def _left_to_edges(self, at: Faced) -> Inside:
        """Which places do not count: those of points inside a shell that face the end of another one, steeply.

        The end's own point is there too; see `facing.Facing.left_to_edges`. Normals are undeformed ones, so that the
        energy is a function of the state.
        """
        end = (at.X == 1.0).astype(np.int64)
        at_end = ~at.free & (self._beside[at.cell, end] < 0)
        level = np.abs(np.sum(self._rule.normal[at.point] * self._normals[at.cell], axis=1))
        return np.asarray(at_end & (level < STEEP) & ~self._rule.on_edge[at.point])

    def _jets(self, X: Array, nodal: Array) -> Array:
        """(3, n, 2): places and two derivatives, of the curves through nodes (n, functions, 2)."""
        return np.asarray(np.einsum("dnk,nki->dni", self._table(2, X), nodal))

    def _table(self, order: int, X: Array) -> Array:
        """Shape functions and derivatives (order + 1, n, functions); basix takes no empty X."""
        if not len(X):
            return np.zeros((order + 1, 0, self._nodes.shape[1]))
        return np.asarray(self._element.tabulate(order, X[:, None])[..., 0])

    def _geometry(self, at: Faced) -> tuple[Array, Array, Array, Longs]:
        """x - y, n, and beta (n, functions of both cells) with its nodes."""
        nodes = np.concatenate([self._nodes[self._rule.cell[at.point]], self._nodes[at.cell]], axis=1)
        r = self._r0 + self._at
        N, shape = self._rule.shape[at.point], self._table(0, at.X)[0]
        beta = np.concatenate([N, -shape], axis=1)
        off = np.einsum("nk,nki->ni", beta, r[nodes])
        return off, off / np.linalg.norm(off, axis=1)[:, None], beta, nodes

    def _second(self, m: float) -> tuple[Array, Longs]:
        """(n, dofs, dofs) by (U, V, W) at the nodes of both cells, over the whole circumference."""
        at = self._pressed()
        _, first, second = self._penalty(at)
        off, n, beta, nodes = self._geometry(at)
        count, functions = beta.shape
        half, d = functions // 2, at.distance
        weight = self._rule.weight[at.point] / 2
        bent = -weight * first / d
        y, along, curved = self._jets(at.X, (self._r0 + self._at)[self._nodes[at.cell]])
        slopes = self._table(1, at.X)[1]
        normal, slide, turn = (np.zeros((count, functions, 3)) for _ in range(3))
        normal[..., ::2] = beta[..., None] * n[:, None]
        slide[..., ::2] = -beta[..., None] * along[:, None]
        slide[:, half:, ::2] -= slopes[..., None] * off[:, None]
        turn[..., 1] = -beta * y[:, :1]
        shape = -beta[:, half:]
        turn[:, half:, 0] += m * off[:, :1] * shape
        turn[:, half:, 1] += off[:, :1] * shape
        turn[:, half:, 2] += m * off[:, 1:] * shape
        A = np.sum(along * along - off * curved, axis=1)
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
    pairs: Sequence[Pair], r0: fem.Function, u: fem.Function, patches: Mapping[str, Inside], h: float, degree: int
) -> list[MeridianTouching]:
    """The contacts of pairs of shells.

    Raises
    ------
    MeshError
        If a pair overlaps undeformed.
    """
    made = list[MeridianTouching]()
    for pair in pairs:
        one, other = (patches[name] for name in pair.names)
        made.append(MeridianTouching(pair, r0, u, (one, other), h, degree))
        made[-1].refuse_overlap(h)
    return made


def _entries(H: Array, nodes: Longs, size: int) -> Entries:
    """Blocks (n, dofs, dofs) by the unknowns at nodes (n, functions), `size` at each."""
    dofs = (size * nodes[..., None] + np.arange(size)).reshape(len(nodes), size * nodes.shape[1])
    rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None])
    return rows.ravel(), columns.ravel(), H.ravel()
