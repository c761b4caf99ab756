"""A magnetised shell at points of its cells, with coordinates (a, b) in [0, 1]² that triangles and
rings share.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
STEP = 1e-30  # of imaginary changes


@dataclass
class Nodal:
    """Derivatives by the displacement and by the remanence at the nodes of cells, (cells, nodes, 3)
    each.

    Attributes
    ----------
    by_place, by_thickness
        The same by the undeformed place and (cells, nodes) by what multiplies the thickness, at
        nodes of their elements; None if nobody asks for them.
    """

    by_u: Array
    by_remanence: Array
    by_place: Array | None = None
    by_thickness: Array | None = None


@dataclass(frozen=True)
class Shape:
    """The cells of a shell with what is magnetised, at nodes.

    Attributes
    ----------
    element
        Of r0 and u.
    r0, u
        (cells, nodes, components) at its nodes.
    of_remanence
        Of the remanence, discontinuous.
    remanence
        (cells, nodes, 3), in the undeformed shell.
    h
        Thickness over R.
    thick
        What multiplies it, with its element; None for 1.
    swept
        Whether the cells are those of a meridian.
    thins
        1 where the thickness follows from the area, so that the volume stays; of each cell (cells,
        1), or of all.
    """

    element: Any
    r0: Array
    u: Array
    of_remanence: Any
    remanence: Array
    h: float
    thick: tuple[Any, Array] | None = None
    swept: bool = False
    thins: Array | float = 0

    def reference(self, ab: Array) -> tuple[Array, Array, Array]:
        """Places on the reference cell of coordinates (n, m, 2), their derivatives (n, m, 2, d),
        and azimuths (n, m).

        A triangle is a square whose side a = 1 is a corner; a ring has the azimuth b over a turn,
        or a part of it.
        """
        a, b = ab[..., 0], ab[..., 1]
        if self.swept:
            return a[..., None], np.stack([np.ones_like(a), np.zeros_like(a)], -1)[..., None], b
        one = np.ones_like(a)
        slopes = np.stack([np.stack([one, -b], -1), np.stack([0 * one, 1 - a], -1)], -2)
        return np.stack([a, (1 - a) * b], -1), slopes, 0 * a

    def thickness(self, cells: Ints, X: Array) -> Array:
        """The thickness over R and its derivatives by X (.., n, m) at places (n, m, d) of reference
        cells.
        """
        if self.thick is None:
            thickness = np.zeros((3, *X.shape[:2]))
            thickness[0] = self.h
            return thickness
        element, values = self.thick
        return np.asarray(self.h * np.einsum("dnmk,nk->dnm", tables(element, X, 1), values[cells]))

    def nothing(self, *, of_shape: bool = False) -> Nodal:
        """Derivatives to add to; `of_shape`: those by the undeformed place and the thickness too."""
        zero = Nodal(np.zeros_like(self.r0), np.zeros_like(self.remanence))
        if not of_shape:
            return zero
        thick = np.zeros((len(self.r0), 0)) if self.thick is None else np.zeros_like(self.thick[1])
        return replace(zero, by_place=np.zeros_like(self.r0), by_thickness=thick)

    def back_of_thickness(self, cells: Ints, X: Array, on: Array, into: Nodal) -> None:
        """Add what thicknesses (n, m) in cells (n,) have at places X (m, d) of their reference
        cell.
        """
        if self.thick and into.by_thickness is not None:
            T = self.thick[0].tabulate(0, X)[0, :, :, 0]
            np.add.at(into.by_thickness, cells, self.h * on @ T)


def tables(element: Any, X: Array, order: int) -> Array:
    """(derivatives, n, m, nodes) of an element at places (n, m, d)."""
    flat = element.tabulate(order, X.reshape(-1, X.shape[-1]))[..., 0]
    return np.asarray(flat.reshape(len(flat), *X.shape[:2], -1))


def turned(v: Array, angle: Array, way: float = 1.0) -> Array:
    """Vectors (n, m, ..., 3) turned about e3 by angles (n, m)."""
    c, s = np.cos(angle), way * np.sin(angle)
    c, s = (each.reshape(*angle.shape, *[1] * (v.ndim - 3)) for each in (c, s))
    return np.stack(
        [c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1], v[..., 2]], axis=-1
    )


@dataclass(frozen=True)
class Jets:
    """A shell at points of cells: jets by (a, b), those of r0 (6, n, m, 3), of r (3, n, m, 3),
    remanence and thickness.

    Attributes
    ----------
    B
        (3, n, m, 3) the remanence and its derivatives.
    t
        (3, n, m) the thickness over R and its derivatives.
    """

    r0: Array
    r: Array
    B: Array
    t: Array
    shape: Shape
    cells: Ints
    shapes: Array
    of_B: Array
    angle: Array
    ab: Array

    @classmethod
    def of(cls, shape: Shape, cells: Ints, ab: Array, turn: Array | None = None) -> "Jets":
        """At coordinates (n, m, 2) in cells (n,); azimuths of a ring are b times `turn`, by default
        a whole one.
        """
        X, slopes, b = shape.reference(ab)
        angle = 2 * np.pi * b
        T, TB = tables(shape.element, X, 2), tables(shape.of_remanence, X, 1)
        if shape.swept:
            ring = 2 * np.pi
            f0, f = (np.einsum("dnmk,nki->dnmi", T, each[cells]) for each in (shape.r0, shape.u))
            jets = [np.stack([turned(d, angle) for d in _ring(each, ring)]) for each in (f0, f)]
            B = np.einsum("dnmk,nki->dnmi", TB, shape.remanence[cells])
            by_angle = ring * np.stack([-B[0, ..., 1], B[0, ..., 0], 0 * B[0, ..., 0]], -1)
            fields = np.stack([turned(each, angle) for each in (B[0], B[1], by_angle)])
            t = shape.thickness(cells, X)
            t = np.stack([t[0], t[1], 0 * t[0]])
            r0, u = jets
            return cls(r0, r0[:3] + u[:3], fields, t, shape, cells, T, TB, angle, ab)
        T, TB = _chain(T, slopes, ab), _chain(TB, slopes, ab)
        r0, u = (np.einsum("dnmk,nki->dnmi", T, each[cells]) for each in (shape.r0, shape.u))
        t = shape.thickness(cells, X)
        if len(t) > 1:
            t = np.concatenate([t[:1], np.einsum("nmad,dnm->anm", slopes, t[1:3])])
        B = np.einsum("dnmk,nki->dnmi", TB, shape.remanence[cells])
        return cls(r0, r0[:3] + u[:3], B, t, shape, cells, T, TB, angle, ab)

    def layer(self, eta: float) -> tuple[Array, Array, Array]:
        """dX/da, dX/db and dX/deta (n, m, 3) of the undeformed shell at a height over the
        thickness.
        """
        _, a1, a2, _a11, _a12, _a22 = self.r0
        n0, (n1, n2) = _normals(self.r0)
        t, t1, t2 = (each[..., None] for each in self.t)
        return a1 + eta * (t * n1 + t1 * n0), a2 + eta * (t * n2 + t2 * n0), t * n0

    @property
    def thickness(self) -> Array:
        """(n, m) of the deformed shell, over R."""
        if not np.any(self.shape.thins):
            return np.asarray(self.t[0])
        area0, area = (np.linalg.norm(np.cross(a[1], a[2]), axis=-1) for a in (self.r0, self.r))
        return np.asarray(self.t[0] * (1 + self._thins * (area0 / area - 1)))

    @property
    def _thins(self) -> Array | float:
        """Of these cells."""
        thins = self.shape.thins
        return np.asarray(thins)[self.cells] if np.ndim(thins) else thins

    def place(self, eta: float) -> Array:
        """(n, m, 3) of the deformed shell."""
        return np.asarray(
            self.r[0] + eta * self.thickness[..., None] * unit(np.cross(self.r[1], self.r[2]))
        )

    def back(self, into: Nodal, on_x: Array, on_n: Array, on_B: Array) -> None:
        """Add dJ/du and dJ/dB at nodes, from dJ/dr and dJ/dn (n, m, 3) and dJ/d(B, B_a, B_b) (3, n,
        m, 3).
        """
        m = np.cross(self.r[1], self.r[2])
        size = np.linalg.norm(m, axis=-1, keepdims=True)
        n = m / size
        along = 1 + np.asarray(self._thins)[..., None]  # the thickness is over |m| too
        across = (on_n - along * np.sum(on_n * n, axis=-1, keepdims=True) * n) / size  # dJ/dm
        on = np.stack([on_x, np.cross(self.r[2], across), np.cross(across, self.r[1])])
        if self.shape.swept:
            on, on_B = (
                np.stack([turned(each, self.angle, -1.0) for each in part]) for part in (on, on_B)
            )
            ring = 2 * np.pi
            flat = np.stack([on[0], on[1]])[..., [0, 2]]  # of f and f_s
            flat[0][..., 0] += ring * on[2][..., 1]  # f_theta = (0, U, 0)
            by_u = np.einsum("dnmk,dnmi->nki", self.shapes[:2], flat)
            of_B = np.stack([on_B[0], on_B[1]])
            of_B[0][..., 0] += ring * on_B[2][..., 1]
            of_B[0][..., 1] -= ring * on_B[2][..., 0]
            by_B = np.einsum("dnmk,dnmi->nki", self.of_B[:2], of_B)
        else:
            by_u = np.einsum("dnmk,dnmi->nki", self.shapes[:3], on)
            by_B = np.einsum("dnmk,dnmi->nki", self.of_B, on_B)
        np.add.at(into.by_u, self.cells, by_u)
        np.add.at(into.by_remanence, self.cells, by_B)

    def back_of_undeformed(self, into: Nodal, of: "Callable[[Jets], Array]", on: Array) -> None:
        """Add what numbers (n, m, l) of the jets of r0 and of the thickness have, times `on`; of
        triangles.

        Their derivatives at each point are those along an imaginary change, exact to rounding.
        """
        if into.by_place is None or into.by_thickness is None:
            return
        by_r0, by_t = np.zeros((6, *self.r0.shape[1:])), np.zeros((3, *self.t.shape[1:]))

        def rate(**moved: Any) -> Array:
            return np.asarray(
                np.sum(on * of(replace(self, **moved)).imag, axis=-1) / STEP, dtype=np.float64
            )

        for d, i in product(range(1, 6), range(3)):
            r0 = self.r0.astype(np.complex128)
            r0[d, ..., i] += STEP * 1j
            by_r0[d, ..., i] = rate(r0=r0)
        for d in range(3):
            t = self.t.astype(np.complex128)
            t[d] += STEP * 1j
            by_t[d] = rate(t=t)
        np.add.at(into.by_place, self.cells, np.einsum("dnmk,dnmi->nki", self.shapes, by_r0))
        if self.shape.thick:
            X, slopes, _ = self.shape.reference(self.ab)
            T = _chain(tables(self.shape.thick[0], X, 1), slopes, self.ab)
            np.add.at(
                into.by_thickness, self.cells, self.shape.h * np.einsum("dnmk,dnm->nk", T, by_t)
            )


def unit(m: Array) -> Array:
    return np.asarray(m / np.linalg.norm(m, axis=-1, keepdims=True))


def _normals(jet: Array) -> tuple[Array, tuple[Array, Array]]:
    """The normal of a jet (6, ..., 3), and its derivatives."""
    _, a1, a2, a11, a12, a22 = jet
    m = np.cross(a1, a2)
    size = np.sqrt(np.sum(m * m, axis=-1, keepdims=True))  # analytic
    n, slopes = m / size, []
    for first, second in ((a11, a12), (a12, a22)):
        change = (np.cross(first, a2) + np.cross(a1, second)) / size
        slopes.append(change - np.sum(change * n, axis=-1, keepdims=True) * n)
    return n, (slopes[0], slopes[1])


def _ring(f: Array, ring: float) -> Array:
    """Jets by (s, b) at azimuth zero of plane vectors with derivatives by s (3, n, m, 2)."""
    (U, W), (Us, Ws), (Uss, Wss) = (np.moveaxis(each, -1, 0) for each in f)
    zero = np.zeros_like(U)
    parts = [(U, zero, W), (Us, zero, Ws), (zero, ring * U, zero)]
    parts += [(Uss, zero, Wss), (zero, ring * Us, zero), (-(ring**2) * U, zero, zero)]
    return np.stack([np.stack(part, axis=-1) for part in parts])


def _chain(T: Array, slopes: Array, ab: Array) -> Array:
    """Derivatives by (a, b) of shape functions, from those by the reference coordinates X = a, Y =
    (1 - a) b.
    """
    value, first = T[0], np.einsum("nmad,dnmk->anmk", slopes, T[1:3])
    if len(T) == 3:
        return np.stack([value, *first])
    XX, XY, YY = T[3:6]
    b, c = ab[..., 1, None], 1 - ab[..., 0, None]
    twice = [XX - 2 * b * XY + b**2 * YY, c * (XY - b * YY) - T[2], c**2 * YY]
    return np.stack([value, *first, *twice])
