"""The remanence as a field that is identified: its numbers, and what is reported of them.

The remanence is given by vectors at control points; each place of the shell has their weighted
mean. Its numbers are the components that may vary, over |B^r|, the size of the remanence. By their
prior the field is smooth: values at near places are correlated. The strengths of the prior are its
deviation and its length, over which the correlation falls (`smoothness_prior`). The vector of all
parameters has the numbers of the field in a block.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.input.tables import VECTORS, write_vectors
from magshell_fenicsx.models.shell.control_points import ControlPoints
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.design.blocks import Vectors, by_components
from magshell_fenicsx.studies.design.variables import controls_of
from magshell_fenicsx.studies.identify.laplace import Posterior
from magshell_fenicsx.studies.identify.sections import RemanenceSection
from magshell_fenicsx.studies.identify.smoothness_prior import Smooth
from magshell_fenicsx.studies.points import Case

Array = NDArray[np.float64]
NAME = "remanence"
FIELD_KEY = f"identify.{NAME}"
MAX_FIELD_NUMBERS = 2_000  # numbers


@dataclass(frozen=True)
class RemanenceField:
    """The remanence as a field that is identified: components at control points, over |B^r|.

    Attributes
    ----------
    controls
        The control points; each place of the shell has their weighted mean.
    start
        (n, 3), or (n, 2) on a meridian: vectors of the case itself, the mean of their prior.
    free_components
        Indices of the components that are identified; on a strip those in the plane of x and z.
    smooth
        The prior, under which the field is smooth.
    """

    controls: ControlPoints
    start: Array
    free_components: tuple[int, ...]
    smooth: Smooth

    @property
    def start_values(self) -> Array:
        """The identified components of the case itself, as a vector; components vary fastest."""
        return np.asarray(self.start[:, self.free_components]).ravel()

    @property
    def names(self) -> list[str]:
        """Names of the identified components, as in a file of vectors."""
        return [VECTORS[self.start.shape[1]][i] for i in self.free_components]

    def derivatives(self, scene: Scene, gradient: FieldGradient) -> Array:
        """Return the derivatives of a result by the numbers of the field, as a vector; collective.

        Parameters
        ----------
        gradient
            Gradient of the result by the remanence as a field on the mesh.
        """
        return np.asarray(by_components(scene, gradient)[:, self.free_components]).ravel()

    def vectors(self, x: Array) -> Array:
        """Return all components (n, 3 | 2) at the points for numbers x of the field."""
        components = np.array(self.start)
        components[:, self.free_components] = x.reshape(len(components), -1)
        return components

    def write(self, x: Array, file: Path) -> None:
        """Write the vectors for numbers x, as a file for a remanence of kind `points`."""
        write_vectors(file, self.controls.places, self.vectors(x))

    def put(self, data: dict[str, Any], file: Path) -> None:
        """Set the remanence in plain data of a case to the vectors of a file."""
        # the vectors are in the file; the block needs no lengths, and does not use its variables
        Vectors(self.controls, self.start, lengths=None).put(data, self.start)
        data["magnetic"]["remanent"]["file"] = str(file.absolute())

    def summary(self, posterior: Posterior, flux_scale: tuple[float, str]) -> dict[str, Any]:
        """Return the identified field as plain data, as in identify.json.

        Parameters
        ----------
        flux_scale
            |B^r| and its unit.
        """
        # the numbers of the field in the vector of parameters, and the prior as the data chose it
        block, prior = self.smooth.block, posterior.measured.field
        assert prior
        shape = (len(self.start), len(self.free_components))
        # of the 95 % bands of its numbers
        lower_ends, upper_ends = (v[block].reshape(shape) for v in posterior.band)
        # deviation and length that were not given, and ended at a bound of the search
        strengths_at_bounds = [
            name for name in prior.at_bounds() if np.isnan(getattr(self.smooth, name))
        ]
        # number of values that the prior determines: the trace of C Q, with the covariance C of the
        # posterior and the inverse covariance Q = W^T W of the prior, whose rows are W
        prior_share = np.trace(posterior.local[block, block] @ prior.rows.T @ prior.rows)
        return {
            "places": self.controls.places.tolist(),
            "components": self.names,
            "value": posterior.x[block].reshape(shape).tolist(),
            "deviation": posterior.deviation[block].reshape(shape).tolist(),
            "low": lower_ends.tolist(),
            "high": upper_ends.tolist(),
            "mean": self.start_values.reshape(shape).tolist(),
            "prior": {
                "deviation": prior.deviation,
                "length": prior.length,
                "at_bounds": strengths_at_bounds,
            },
            "determined": prior.size - float(prior_share),
            "over": {"value": flux_scale[0], "unit": flux_scale[1]},
        }


def field_of(
    source: Source, case: Case, section: RemanenceSection | None, first: int
) -> tuple[RemanenceField | None, Source]:
    """Return the remanence that is identified, and the case with it.

    The case is that of the whole shell unless the vectors stay in a plane. Without a section the
    field is None, and the case unchanged.

    Parameters
    ----------
    section
        The section `identify.remanence`; None if no field is identified.
    first
        Index of the first number of the field in the vector of parameters.

    Raises
    ------
    CaseError
        If the case has no remanence in a field, or its points are too many, too few or at one
        place.
    """
    if section is None:
        return None, source
    # the control points, and the vectors (n, 2 | 3) of the case there
    controls, start = controls_of(case, section.points, section.filter, FIELD_KEY)
    in_plane = controls.is_axisymmetric or case.shell.geometry == "strip"
    # indices of rho and z of (rho, z) on a meridian, of x and z on a strip, else of x, y and z
    free_components = (0, 1) if controls.is_axisymmetric else (0, 2) if in_plane else (0, 1, 2)
    if len(start) * len(free_components) > MAX_FIELD_NUMBERS:
        raise CaseError(
            f"{FIELD_KEY}: {len(start)} points with {len(free_components)} components each; "
            f"allowed are {MAX_FIELD_NUMBERS} numbers"
        )
    if len(start) < 2:
        raise CaseError(
            f"{FIELD_KEY}: a single point is no field: look for numbers of magnetic.remanent "
            "instead"
        )
    distances = scipy.spatial.distance.cdist(controls.places, controls.places)
    least_distance = distances[np.triu_indices(len(distances), 1)].min()
    if least_distance <= 1e-9:
        raise CaseError(f"{FIELD_KEY}: two of its points are at the same place")
    smooth = Smooth(
        first,
        distances,
        components=len(free_components),
        deviation=section.deviation or np.nan,  # the data choose what is not given
        length=section.length or np.nan,
    )
    if not in_plane:  # identified vectors have no symmetry
        source = Source(
            source.name,
            {**source.data, "symmetry": "none"},
            source.places,
            source.folder,
            source.files,
        )
    return RemanenceField(controls, start, free_components, smooth), source


def without_room(other: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    """Return why a case has no place for the field of another case; "" if it has.

    Parameters
    ----------
    other, data
        Plain data of the case, and of the case whose field is identified.
    """
    if not (other.get("magnetic") or {}).get("remanent"):
        return f"has no magnetic.remanent, and {FIELD_KEY} is looked for"
    other_geometry, geometry = (
        (case_data.get("shell") or {}).get("geometry", "hemisphere") for case_data in (other, data)
    )
    return (
        ""
        if other_geometry == geometry
        else f"its geometry is {other_geometry}: the points of {FIELD_KEY} are on a {geometry}"
    )


def flux_density(case: Case) -> tuple[float, str]:
    """Return |B^r| and its unit: a value in mT, or (1, "") for a case without units."""
    density = (
        case.magnetic.remanent.flux_density if case.magnetic and case.magnetic.remanent else None
    )
    return (1e3 * abs(density), "mT") if density else (1.0, "")


def words(field: Mapping[str, Any]) -> list[str]:
    """Return sentences about the identified field, whose content is as in identify.json."""
    flux_scale, prior = field["over"], field["prior"]
    unit = f" {flux_scale['unit']}" if flux_scale["unit"] else " |B^r|"
    deviation = flux_scale["value"] * np.array(field["deviation"])
    numbers = deviation.size
    sentences = [
        f"{NAME}: {numbers} numbers at {len(deviation)} points, of which the data determine "
        f"{field['determined']:.1f}; "
        f"standard deviations {deviation.min():.3g} to {deviation.max():.3g}{unit}",
        f"{NAME}: its prior is smooth over {prior['length']:.3g} R, with the deviation "
        f"{flux_scale['value'] * prior['deviation']:.3g}{unit}",
    ]
    # deviation or length that the data were to choose, but that ended at a bound of the search
    if prior["at_bounds"]:
        sentences.append(
            f"warning: the data do not say the {' and the '.join(prior['at_bounds'])} of the prior "
            f"of the {NAME}: give "
            f"{' and '.join(f'{FIELD_KEY}.{name}' for name in prior['at_bounds'])}"
        )
    return sentences
