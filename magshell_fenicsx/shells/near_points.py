"""The part of a mode that lies within a thickness of a point force, where no shell theory holds.

Under a point force a shell without transverse shear bends without limit: its curvature K grows as
the logarithm of the distance. The second variation of the bending energy along stretches is of the
order of h^2 K^2 of the membrane's stiffness, and negative. So where K exceeds about 1/h, modes
around the point become unstable, at loads that fall with the size of elements there. Such modes are
known by their extent: the gradient of a mode of the shell extends over sqrt(R h) and more, theirs
over a part of h.

A mode is a displacement, or a wave m around an axisymmetric shell: U cos(m theta) e_rho + V sin(m
theta) e_theta + W cos(m theta) e_z, with coefficients (U + V, V, W) at nodes. Lengths are over R.
"""

from collections.abc import Mapping

import basix
import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.models.shell.parameters import PointForce
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.mass import Model

Array = NDArray[np.float64]
MIN_SHARE_AT_POINT = (
    0.5  # share of the squared gradient near a point from which a mode belongs to that point
)


def places_of_point_forces(model: Model, loads: Loads) -> Mapping[str, Array]:
    """Return the undeformed places of all point forces of a shell, by the names of points.

    A place is (3,) over R, on a meridian (rho, z). A solid has none: there a force is spread over a
    patch. Dead loads (`all_dead`) keep their direction; some are forces at points.
    """
    names = {force.point for force in loads.forces.values() if not force.patch}
    names |= {load.point for load in loads.all_dead if isinstance(load, PointForce)}
    ordered = sorted(names)  # the same order on all ranks
    if model.axisymmetric:
        places = {}
        for name in ordered:
            parameter = model.meridian.points[name][:1]  # without the azimuth that comes second
            places[name] = model.meridian.section(np.array(parameter))[0]  # (rho, z)
        return places
    surface = model.midsurface if model.thin else None
    return {name: surface.points[name] for name in ordered} if surface else {}


def point_of_mode(
    model: Model, places: Mapping[str, Array], mode: Vector, waves: int | None = None
) -> str:
    """Return the name of the point force at which a mode is concentrated; collective.

    Most of its squared gradient, `MIN_SHARE_AT_POINT`, lies within a thickness of that point. The
    name is "" if there is no such point.

    Parameters
    ----------
    places
        Undeformed places of all point forces by name, as `places_of_point_forces` gives them.
    mode
        This rank's part of a displacement. With `waves` it holds the coefficients (U + V, V, W) of
        that number of waves around the axis.
    """
    x, squares = squared_gradient(model, mode, waves)
    # every rank holds all of a meridian
    comm = model.system.comm if not model.axisymmetric else None

    def total(values: Array) -> float:
        """Return the sum of all values of all ranks."""
        of_rank = float(values.sum())
        return float(comm.allreduce(of_rank)) if comm else of_rank

    whole_square = total(squares)
    for name, place in places.items():
        is_near = np.linalg.norm(x - place, axis=-1) < model.material.h
        if total(squares[is_near]) > MIN_SHARE_AT_POINT * whole_square:
            return name
    return ""


def squared_gradient(model: Model, mode: Vector, waves: int | None) -> tuple[Array, Array]:
    """Return the squared gradient of a mode at quadrature points, times their area.

    Parameters
    ----------
    mode
        This rank's part of a displacement, or the coefficients of a wave.
    waves
        Wave number m around the axis; None for a displacement.

    Returns
    -------
    places
        (cells, points, 3) undeformed places of this rank over R; on a meridian (cells, points, 2).
    squares
        (cells, points) squared gradient along the undeformed surface, times area and weight.
    """
    V, element = model.V, model.V.element.basix_element
    X, weights = basix.make_quadrature(V.mesh.basix_cell(), 2 * element.degree)
    owned = V.mesh.topology.index_map(V.mesh.topology.dim).size_local
    nodes, shapes = V.dofmap.list[:owned], element.tabulate(1, X)[..., 0]

    def jets(values: Array) -> Array:
        """Return the value at points, then its derivatives, of values (nodes, components) at nodes.

        The shape is (1 + dim, cells, points, components).
        """
        return np.asarray(np.einsum("dqn,cni->dcqi", shapes, values[nodes]))

    r = jets(model.r0.x.array.reshape(-1, V.dofmap.bs))  # of the undeformed places
    if model.axisymmetric:
        v = jets(_wave_at_nodes(mode, model.system.size, waves))  # coefficients U, V and W
        return r[0], _squares_on_meridian(r, v, waves or 0) * weights
    v = jets(model.system.with_ghosts(mode[: model.system.size]).reshape(-1, 3))
    # |grad v|² = g^ab v,_a . v,_b
    metric = np.einsum("acqi,bcqi->cqab", r[1:], r[1:])
    inverse = np.linalg.inv(metric)
    squares = np.einsum("cqab,acqi,bcqi->cq", inverse, v[1:], v[1:])
    return r[0], squares * np.sqrt(np.linalg.det(metric)) * weights


def _wave_at_nodes(mode: Vector, size: int, waves: int | None) -> Array:
    """Return the coefficients (nodes, 3) U, V and W of a mode on a meridian.

    Without `waves` the mode is a displacement (U, W) of `size` numbers, and V is zero.
    """
    if waves is None:
        U, W = np.moveaxis(mode[:size].reshape(-1, 2), 1, 0)
        return np.column_stack([U, 0 * U, W])
    P, V, W = np.moveaxis(mode.reshape(-1, 3), 1, 0)  # P = U + V
    return np.column_stack([P - V, V, W])


def _squares_on_meridian(r: Array, v: Array, m: int) -> Array:
    """Return the squared gradient of a wave m times area per radian and reference coordinate.

    `r` (2, cells, points, 2) and `v` (2, cells, points, 3) are the places (rho, z) and the
    coefficients (U, V, W), each with its derivatives by the reference coordinate.
    """
    # speed: length of the meridian per reference coordinate
    rho, speed = r[0, ..., 0], np.linalg.norm(r[1], axis=-1)
    U, V, W = np.moveaxis(v[0], -1, 0)
    # square of the derivative by theta, which is (U + m V) cos along e_theta, -(m U + V) sin along
    # e_rho and -m W sin along e_z
    around = (U + m * V) ** 2 + (m * U + V) ** 2 + (m * W) ** 2
    along = np.sum(v[1] ** 2, axis=-1)
    # the factor of the whole turn is left out: it is the same everywhere
    return np.asarray((along / speed**2 + around / rho**2) * rho * speed)
