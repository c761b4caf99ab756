"""The largest contact pressure, and the force per length of a contact narrower than a cell.

Both are of the quadrature points, beside the pressure that is a mean over each cell.

Lengths are over R, pressures over E h/R, forces over E h R. On a meridian points are (rho, 0, z),
and each stands for a ring.
"""

from dataclasses import dataclass, field
from math import nan
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.parts.penalty_contact import PressedPoints

if TYPE_CHECKING:
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
REACH_ALONG_LINE = 2.3  # square roots of a cell's area: some one and a half sides
MIN_LENGTH_OF_LINE = 1.0  # square roots of a cell's area: a shorter contact is a spot
MAX_WIDTH_OF_LINE = 0.5  # over its length
MAX_SAMPLED_POINTS = 200  # around which the force per length is computed


@dataclass(frozen=True)
class ContactPeak:
    """Numbers of a contact at its quadrature points.

    Attributes
    ----------
    pressure
        Largest pressure, over E h/R.
    line_force
        Force per length over E h of a contact along a line; nan where it is in a spot.
    force
        Sum of all normal forces, of the whole shell, over E h R.
    pressure_error, force_error
        Estimated errors of `pressure` and `force` by the mesh, as parts of them; nan if unknown.
    is_median
        Whether `line_force` is the median of all places, of a surface; else it is the largest one,
        of a meridian.
    """

    pressure: float
    line_force: float
    force: float
    pressure_error: float = nan
    force_error: float = nan
    is_median: bool = field(default=False, kw_only=True)


def contact_peak(
    model: "ShellModel | MeridianModel", state: State, mirror: Mirror | None = None
) -> ContactPeak | None:
    """Return the numbers of all contacts of a model at a state; None without touch. Collective.

    `mirror` has the images that make the whole shell of a half or a sector.
    """
    contacts, comm = model.all_contacts, model.system.comm
    if not contacts:
        return None
    evaluation = model.system.at_state(state)
    points_of_contacts = evaluation.evaluate(lambda: [c.pressed_points() for c in contacts])
    points = PressedPoints.union(points_of_contacts, comm)
    if not len(points.pressure):
        return None
    if mirror:
        points = points.with_images(mirror)
    forces = points.pressure * points.area
    is_surface = len(model.axes) != 2
    along_line = _along_surface if is_surface else _along_meridian
    return ContactPeak(
        pressure=float(points.pressure.max()),
        line_force=along_line(points, forces),
        force=float(forces.sum()),
        is_median=is_surface,
    )


def _along_meridian(points: PressedPoints, forces: Array) -> float:
    """Return the largest force per length of rings, each within the length of a cell.

    It is nan if most of the force is in a spot about the axis.
    """
    rho = points.places[:, 0]
    circumference = 2 * np.pi * np.maximum(rho, np.finfo(float).tiny)
    size = points.cell_area / circumference
    is_ring = rho > 2 * size
    if forces[is_ring].sum() < forces.sum() / 2:
        return nan
    tree, per_length = scipy.spatial.cKDTree(points.places), forces / circumference
    neighbours = tree.query_ball_point(points.places[is_ring], size[is_ring])
    return float(max(per_length[indices].sum() for indices in neighbours))


def _along_surface(points: PressedPoints, forces: Array) -> float:
    """Return the median of the forces per length around points; nan if most are in spots."""
    count = len(forces)
    sample = np.linspace(0, count - 1, min(count, MAX_SAMPLED_POINTS)).astype(int)
    cell_size = np.sqrt(points.cell_area[sample])
    neighbours = scipy.spatial.cKDTree(points.places).query_ball_point(
        points.places[sample], REACH_ALONG_LINE * cell_size
    )
    forces_per_length = np.array(
        [
            _per_length(points.places[indices], forces[indices], MIN_LENGTH_OF_LINE * size)
            for indices, size in zip(neighbours, cell_size, strict=True)
        ]
    )
    is_line, weights = np.isfinite(forces_per_length), forces[sample]
    if weights[is_line].sum() < weights.sum() / 2:
        return nan
    order = np.argsort(forces_per_length[is_line])
    weights = weights[is_line][order]
    middle = np.searchsorted(np.cumsum(weights), weights.sum() / 2)
    return float(forces_per_length[is_line][order][middle])


def _per_length(places: Array, forces: Array, min_length: float) -> float:
    """Return the sum of forces (n,) at places (n, 3) over the length of their line; nan of a spot.

    A spot is nearly as wide as long, or shorter than `min_length`: the mesh does not show whether
    it is a line. An even force on a straight line of the length L has the variance L²/12 along it.
    """
    from_middle = places - forces @ places / forces.sum()
    covariance = (forces[:, None] * from_middle).T @ from_middle / forces.sum()
    *_, second_variance, largest_variance = np.linalg.eigvalsh(covariance)
    is_wide = second_variance > MAX_WIDTH_OF_LINE**2 * largest_variance
    length = np.sqrt(12 * max(largest_variance, 0.0))
    if is_wide or length < min_length:
        return nan
    return float(forces.sum() / length)
