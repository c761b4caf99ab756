"""Stresses at points of a shell or of a meridian, which may be anywhere in cells.

Strains and moments of finite elements jump between cells. At a point a polynomial of the
displacement's degree is fitted to their samples in the cells that have the point, as in the
recovery of fields (`output/fields/recovery.py`): in one cell, or in all that meet at a vertex. The
gradient of the moments gives the shear force, Q = div M.

Samples are quadrature points of cells. The coordinates of a fit are those in the tangent plane of
the point; on a meridian the one along it. A jet (6, cells, q, 3) is a field with its first and
second derivatives at q places of each cell. Lengths are over R, tensors are in space.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import basix
import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Image, rotation
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.polynomial_fit import polynomial_fits
from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.parts.stress import StressPoint, StressState
from magshell_fenicsx.platform import compat
from magshell_fenicsx.shells.revolution import revolved
from magshell_fenicsx.shells.stress_resultants import StressResultants

if TYPE_CHECKING:
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
Jets = Callable[[fem.Function, Array], Array]  # of a field at reference places of the cells
SAMPLE_DEGREE = 6  # least degree of the quadrature rule whose points are samples
NEWTON_STEPS = 12
ON_PLANE = 1e-9  # over R: distance of a place from its mirror image where both are one
SAME_DISTANCE = 1e-6  # over the size of a cell: cells that are as near to a point have it in common
LARGEST_DISTANCE = 0.05  # of a point from the surface, over the size of a cell
# difference between cells at a point, of unit normals (some 30 degrees), and relative of the
# thickness and of the material
LARGEST_KINK, LARGEST_STEP = 0.5, 1e-3
AXIS = 1e-9  # distance from the axis over R: what is nearer is on it


@dataclass(frozen=True)
class PointInCells:
    """A point of a surface or of a meridian, and the cells of this rank that have it.

    Attributes
    ----------
    cells, reference
        Numbers (m,) of the cells, and the place (m, d) of the point in the reference cell.
    place, direction
        The point over R, and the unit normal there; of a meridian (rho, z), and the unit tangent.
    """

    cells: Numbers
    reference: Array
    place: Array
    direction: Array


def shell_stresses(model: "ShellModel", point: StressPoint, mu: Mapping[str, float]) -> StressState:
    """Return the stresses at a point, at the state that the model has been set to; collective.

    `mu` has the amplitudes of the state.

    Raises
    ------
    MeshError
        On every rank, if the point is not on the surface, or where different parts of it meet.
    """
    location = point_of_shell(model, point)
    samples, rule = basix.make_quadrature(basix.CellType.triangle, max(SAMPLE_DEGREE, model.degree))
    frame, tensors = _sampled(
        model, location.cells, partial(_derivatives, location.cells), samples, mu
    )
    in_space = {name: frame.tensor(S).reshape(-1, 9) for name, S in tensors.items()}
    weights = frame.area * rule
    of_ranks = model.V.mesh.comm.allgather((frame.jet[0].reshape(-1, 3), weights.ravel(), in_space))
    places, weights = (np.concatenate([samples[i] for samples in of_ranks]) for i in (0, 1))
    t = _frame_across(location.direction)
    # a point on a mirror plane has cells on both sides of it
    images = images_at(model, location.place)
    places = np.concatenate([image.apply(places) for image in images])
    local_places = (places - location.place) @ t.T
    weights = np.tile(weights, len(images))
    values, gradients = dict[str, Array](), dict[str, Array]()
    for name in tensors:
        S = np.concatenate([samples[2][name] for samples in of_ranks]).reshape(-1, 3, 3)
        all_values = np.concatenate([image.Q @ S @ image.Q.T for image in images])
        value, gradient = fit(local_places, weights, all_values.reshape(-1, 9), model.degree)
        values[name], gradients[name] = value.reshape(3, 3), gradient.reshape(-1, 3, 3)
    shear = np.einsum("ai,aij->j", t, gradients["M"])
    return StressState(location.direction, location.place, values, shear)


def meridian_stresses(
    model: "MeridianModel", point: StressPoint, mu: Mapping[str, float]
) -> StressState:
    """Return the stresses at a point of a meridian, at the azimuth of the point.

    The state is the one that the model has been set to, with the amplitudes `mu`.

    Raises
    ------
    MeshError
        Where different parts of the shell meet.
    """
    location = point_of_meridian(model, point)
    samples, rule = basix.make_quadrature(basix.CellType.interval, max(SAMPLE_DEGREE, model.degree))

    def jets(f: fem.Function, places: Array) -> Array:
        """Return the jets of a field at reference places of the cells, at azimuth 0."""
        return revolved(_derivatives(location.cells, f, places))

    frame, tensors = _sampled(model, location.cells, jets, samples, mu)
    (rho, z), (rho_s, z_s) = location.place, location.direction
    tangent, place = np.array([rho_s, 0.0, z_s]), np.array([rho, 0.0, z])
    local_places = ((frame.jet[0] - place) @ tangent).reshape(-1, 1)
    weights = np.ravel(np.linalg.norm(frame.jet[1], axis=-1) * rule)
    # e_rho, e_theta and e_z at the azimuth of the point
    basis = rotation(float(np.arctan2(point.place[1], point.place[0])))
    normal = np.array([-z_s, 0.0, rho_s])
    t = np.stack([tangent, np.cross(normal, tangent)]) @ basis
    values, shear = dict[str, Array](), 0.0
    for name, components in tensors.items():
        value, (slope,) = fit(local_places, weights, components.reshape(-1, 3), model.degree)
        values[name] = t.T @ value[[[0, 1], [1, 2]]] @ t
        if name == "M" and rho > AXIS:  # on the axis it is zero
            shear = float(slope[0] + (value[0] - value[2]) * rho_s / rho)
    return StressState(normal @ basis, place @ basis, values, shear * t[0])


def images_at(model: "ShellModel", place: Array) -> list[Image]:
    """Return the images of the modelled part that have a place (3,) over R; the part is first."""
    images = model.mirror.images[: model.multiplicity]
    return [image for image in images if np.allclose(image.apply(place), place, atol=ON_PLANE)]


def point_of_shell(model: "ShellModel", point: StressPoint) -> PointInCells:
    """Return where a point is in the cells of a surface; collective.

    Raises
    ------
    MeshError
        On every rank, if it is not on the surface, or where different parts of it meet.
    """
    place, of_shell = point.place, None
    if point.name in model.midsurface.points:  # of several shells one may be meant
        of_shell = model.midsurface.cells_of_point(point.name)
        # where an imperfection has moved the vertex of the perfect shell
        place = model.displacement(model.r0.x.array, point.name)
    cells, reference, distance = nearest_in_cells(model.r0, place, of_shell)
    if distance > LARGEST_DISTANCE:
        raise MeshError(
            f"stress: {point.name}: is {distance:.2g} times the size of a cell away from the "
            "surface: give a place on it"
        )
    places, slopes = at_places(model.r0, cells, reference)
    normals = _unit(np.cross(slopes[:, 0], slopes[:, 1]))
    of_ranks = model.V.mesh.comm.allgather(
        (places, normals, _thickness_and_material(model, cells, reference))
    )
    places, normals, properties = map(np.concatenate, zip(*of_ranks, strict=True))
    refuse_meeting(point.name, normals, properties)
    return PointInCells(cells, reference, places.mean(axis=0), _unit(normals.sum(axis=0)))


def point_of_meridian(model: "MeridianModel", point: StressPoint) -> PointInCells:
    """Return where a point is in the cells of a meridian.

    Raises
    ------
    MeshError
        Where different parts of the shell meet.
    """
    s, _ = model.meridian.points[point.name]
    begin, end = model.V.mesh.geometry.x[compat.geometry_dofs(model.V.mesh), 0].T
    reference = (s - begin) / (end - begin)
    cells = np.flatnonzero(np.abs(reference - 0.5) < 0.5 + SAME_DISTANCE)
    places_in_cells = reference[cells, None]
    places, slopes = at_places(model.r0, cells, places_in_cells)
    tangents = _unit(slopes[:, 0])
    refuse_meeting(point.name, tangents, _thickness_and_material(model, cells, places_in_cells))
    return PointInCells(cells, places_in_cells, places.mean(axis=0), _unit(tangents.sum(axis=0)))


def nearest_in_cells(
    r0: fem.Function, place: Array, allowed: NDArray[np.bool_] | None = None
) -> tuple[Numbers, Array, float]:
    """Return where a surface is nearest to a place; collective.

    Parameters
    ----------
    r0
        Placement.
    place
        (3,) over R.
    allowed
        Flags (cells,) of the local cells that count; None for all.

    Returns
    -------
    cells
        Numbers (m,) of this rank's own cells that have the nearest place.
    reference
        (m, 2) the nearest place in the reference cell.
    distance
        From `place` to the surface, over the size of a cell there.
    """
    V = r0.function_space
    comm, own = V.mesh.comm, V.mesh.topology.index_map(2).size_local
    nodes = r0.x.array.reshape(-1, 3)[V.dofmap.list[:own]]
    centres = nodes.mean(axis=1)
    sizes = np.linalg.norm(nodes - centres[:, None], axis=-1).max(axis=1)
    is_near = np.linalg.norm(centres - place, axis=-1) < 2 * sizes
    cells = np.flatnonzero(is_near if allowed is None else is_near & allowed[:own])
    X: Array = np.full((len(cells), 2), 1 / 3)
    for _ in range(NEWTON_STEPS):  # the method of Gauss and Newton, within the reference cell
        r, slopes = at_places(r0, cells, X)
        metric = np.einsum("mai,mbi->mab", slopes, slopes)
        descent = np.einsum("mai,mi->ma", slopes, place - r)
        X = _in_triangle(X + np.linalg.solve(metric, descent[..., None])[..., 0])
    r, _ = at_places(r0, cells, X)
    distances = np.linalg.norm(r - place, axis=-1)
    nearest_of_rank = min(zip(distances, sizes[cells], strict=True), default=(np.inf, 1.0))
    distance, size = min(comm.allgather(nearest_of_rank))
    has_place = distances <= distance + SAME_DISTANCE * size
    return cells[has_place], X[has_place], float(distance / size)


def at_places(f: fem.Function, cells: Numbers, places: Array) -> tuple[Array, Array]:
    """Return values (m, i) and derivatives (m, d, i) of a field at one place in each of m cells.

    `places` (m, d) are in the reference cell.
    """
    V = f.function_space
    table = V.element.basix_element.tabulate(1, places)[..., 0]  # (1 + d, m, k)
    nodal_values = f.x.array.reshape(-1, V.dofmap.bs)[V.dofmap.list[cells]]
    values, *slopes = np.einsum("dmk,mki->dmi", table, nodal_values)
    return values, np.stack(slopes, axis=1)


def refuse_meeting(name: str, directions: Array, properties: Array) -> None:
    """Refuse a point where different parts of a shell meet, where stresses have no single value.

    Parameters
    ----------
    name
        Name of the point, for the message.
    directions
        (m, i) unit normals or tangents there, of each cell that has the point.
    properties
        (m, j) thickness and material of these cells.

    Raises
    ------
    MeshError
        With the name.
    """
    has_kink = np.ptp(directions, axis=0).max() > LARGEST_KINK
    if has_kink or np.any(
        np.ptp(properties, axis=0) > LARGEST_STEP * np.abs(properties).max(axis=0)
    ):
        raise MeshError(
            f"stress: {name}: is where parts of the shell meet at an angle, or with other "
            "thickness or material: give a place beside it"
        )


def fit(places: Array, weights: Array, values: Array, degree: int) -> tuple[Array, Array]:
    """Return value (j,) and gradient (d, j) at the origin of polynomials fitted to samples.

    `places` (n, d), `weights` (n,) and `values` (n, j) are those of the samples.
    """
    fits, size = polynomial_fits(places[None], weights[None], degree)
    coefficients = fits[0] @ values
    # constant first; then the linear ones, that of the last variable first
    dimensions = places.shape[1]
    return coefficients[0], coefficients[1 : 1 + dimensions][::-1] / size[0]


def _sampled(
    model: "ShellModel | MeridianModel",
    cells: Numbers,
    jets: Jets,
    samples: Array,
    mu: Mapping[str, float],
) -> tuple[TangentFrame, dict[str, Array]]:
    """Return frames (m, q) at samples in cells, and components (m, q, 3) of M, N and stresses."""
    materials = model.cell_materials
    of_cells = None
    if materials is not None:
        numbers = materials.function_space.dofmap.list[cells, 0]
        of_cells = materials.x.array.reshape(-1, 4)[numbers]
    thickness = None
    if model.thickness is not None:
        thickness = _derivatives(cells, model.thickness, samples)[0, ..., 0]
    stresses = StressResultants(
        jets(model.r0, samples), model.material, thickness, model.loads.natural, of_cells
    )
    u = jets(model.u, samples)
    return stresses.frame, {"M": stresses.values_of(u, mu)["M"], **stresses.forces_of(u, mu)}


def _thickness_and_material(
    model: "ShellModel | MeridianModel", cells: Numbers, places: Array
) -> Array:
    """Return thickness and material (m, j) at one reference place (m, d) in each of m cells."""
    fields = [field for field in (model.thickness, model.cell_materials) if field is not None]
    values = [at_places(field, cells, places)[0] for field in fields]
    return np.concatenate([np.ones((len(cells), 1)), *values], axis=1)


def _derivatives(cells: Numbers, f: fem.Function, places: Array) -> Array:
    """Return the derivatives (order 0 to 2, m, q, i) of a field at reference places of cells.

    `places` (q, d) are those in each of the m cells.
    """
    V = f.function_space
    table = V.element.basix_element.tabulate(2, places)[..., 0]
    nodal_values = f.x.array.reshape(-1, V.dofmap.bs)[V.dofmap.list[cells]]
    return np.asarray(np.matmul(table[:, None], nodal_values))


def _in_triangle(X: Array) -> Array:
    """Return places (m, 2), moved into the reference triangle."""
    barycentric = np.column_stack([1 - X.sum(axis=1), X]).clip(min=0.0)
    return np.asarray((barycentric / barycentric.sum(axis=1, keepdims=True))[:, 1:])


def _frame_across(normal: Array) -> Array:
    """Return two orthogonal unit vectors (2, 3) across a unit vector (3,)."""
    first = _unit(np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))]))
    return np.stack([first, np.cross(normal, first)])


def _unit(v: NDArray[np.floating[Any]]) -> Array:
    """Return vectors (..., i) over their lengths."""
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
