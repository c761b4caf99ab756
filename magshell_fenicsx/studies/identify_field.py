"""The remanence as a field that is looked for: its numbers among the parameters, and what is found
of it.
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
from magshell_fenicsx.studies.design_blocks import Vectors, by_components
from magshell_fenicsx.studies.design_variables import controls_of
from magshell_fenicsx.studies.identify_sections import RemanenceSection
from magshell_fenicsx.studies.laplace import Posterior
from magshell_fenicsx.studies.runner import Case
from magshell_fenicsx.studies.smooth import Smooth

Array = NDArray[np.float64]
NAME = "remanence"
FIELD_KEY = f"identify.{NAME}"
MAX_FIELD_NUMBERS = 2_000  # numbers


@dataclass(frozen=True)
class RemanenceField:
    """Components of the remanence at points, over |B^r|.

    Attributes
    ----------
    start
        (n, 3), or (n, 2) on a meridian: vectors of the case itself, the mean of their prior.
    free
        The components that are looked for; on a strip those in the plane of x and z.
    """

    controls: ControlPoints
    start: Array
    free_components: tuple[int, ...]
    smooth: Smooth

    @property
    def start_values(self) -> Array:
        """The numbers of the case itself."""
        return np.asarray(self.start[:, self.free_components]).ravel()

    @property
    def names(self) -> list[str]:
        """The components that are looked for, as in a file of vectors."""
        return [VECTORS[self.start.shape[1]][i] for i in self.free_components]

    def derivatives(self, scene: Scene, gradient: FieldGradient) -> Array:
        """The derivatives by the numbers; collective."""
        return np.asarray(by_components(scene, gradient)[:, self.free_components]).ravel()

    def vectors(self, x: Array) -> Array:
        """All components at the points."""
        components = np.array(self.start)
        components[:, self.free_components] = x.reshape(len(components), -1)
        return components

    def write(self, x: Array, file: Path) -> None:
        """Write the vectors, as a remanence of kind: points takes them."""
        write_vectors(file, self.controls.places, self.vectors(x))

    def put(self, data: dict[str, Any], file: Path) -> None:
        """Let a case have the vectors of a file."""
        Vectors(self.controls, self.start, None).put(data, self.start)
        data["magnetic"]["remanent"]["file"] = str(file.absolute())

    def summary(self, posterior: Posterior, flux_scale: tuple[float, str]) -> dict[str, Any]:
        """Return the identified field as plain data; `flux_scale` is |B^r| and its unit."""
        block, prior = self.smooth.block, posterior.measured.field
        assert prior
        shape = (len(self.start), len(self.free_components))
        low, high = (v[block].reshape(shape) for v in posterior.band)
        fields_at_bounds = [
            name for name in prior.at_bounds() if np.isnan(getattr(self.smooth, name))
        ]
        prior_share = np.trace(posterior.local[block, block] @ prior.rows.T @ prior.rows)
        return {
            "places": self.controls.places.tolist(),
            "components": self.names,
            "value": posterior.x[block].reshape(shape).tolist(),
            "deviation": posterior.deviation[block].reshape(shape).tolist(),
            "low": low.tolist(),
            "high": high.tolist(),
            "mean": self.start_values.reshape(shape).tolist(),
            "prior": {
                "deviation": prior.deviation,
                "length": prior.length,
                "at_bounds": fields_at_bounds,
            },
            "determined": prior.size - float(prior_share),
            "over": {"value": flux_scale[0], "unit": flux_scale[1]},
        }


def field_of(
    source: Source, case: Case, section: RemanenceSection | None, first: int
) -> tuple[RemanenceField | None, Source]:
    """The remanence that is looked for, as parameters from `first` on, and the case whose model has
    room for it.

    Raises
    ------
    CaseError
        If the case has no remanence in a field.
    """
    if section is None:
        return None, source
    controls, start = controls_of(case, section.points, section.filter, FIELD_KEY)
    in_plane = controls.is_axisymmetric or case.shell.geometry == "strip"
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
        len(free_components),
        section.deviation or np.nan,
        section.length or np.nan,
    )
    if not in_plane:
        source = Source(
            source.name,
            {**source.data, "symmetry": "none"},
            source.places,
            source.folder,
            source.files,
        )
    return RemanenceField(controls, start, free_components, smooth), source


def without_room(other: Mapping[str, Any], data: Mapping[str, Any]) -> str:
    """Why a case has no place for the field of another one, both as plain data; "" if it has."""
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
    """|B^r| in mT; without units (1, "")."""
    density = (
        case.magnetic.remanent.flux_density if case.magnetic and case.magnetic.remanent else None
    )
    return (1e3 * abs(density), "mT") if density else (1.0, "")


def words(field: Mapping[str, Any]) -> list[str]:
    """Describe the identified field in words."""
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
    if prior["at_bounds"]:
        sentences.append(
            f"warning: the data do not say the {' and the '.join(prior['at_bounds'])} of the prior "
            f"of the {NAME}: give "
            f"{' and '.join(f'{FIELD_KEY}.{name}' for name in prior['at_bounds'])}"
        )
    return sentences
