"""Random imperfections from a seed: a smooth field, or dimples at random places.

w0 is the deviation along the outward normal, over R, the reference length. The length of
correlation is given in the unit of a dimple's width, which `half_width` converts.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, ValidationError, ValidationInfo, model_validator

from magshell_fenicsx.input.chance import DefectsSection, generator
from magshell_fenicsx.parts.imperfections.dimple import DimpleSection
from magshell_fenicsx.parts.imperfections.gaussian import GaussianSection
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionGeometry,
    ImperfectionSection,
    half_width,
    number_over,
    sizes_noted,
)
from magshell_fenicsx.shape.reference_shell import ReferenceShell

Array = NDArray[np.float64]
WAVE_COUNT = 512
PLACES_AT_ONCE = 4096  # places


class RandomSection(ImperfectionSection):
    """A Gaussian random field of a given size and length of correlation, or random dimples.

    The field has the covariance δ² exp(-d²/(2 ℓ²)) of two places at the straight distance d. It and
    the dimples depend on the seed alone, not on mesh, machine or ranks.
    """

    kind: Literal["random"]
    seed: int = Field(ge=0, le=2**63 - 1)
    """Chooses one of the random shapes"""
    amplitude: Annotated[float, number_over("h")] | None = Field(default=None, ge=-50, le=50)
    """Standard deviation δ of the field [h]"""
    length: Annotated[float, number_over("width")] | None = Field(default=None, ge=0.05, le=1e3)
    """Length of correlation ℓ of the field, in the unit of a dimple's width"""
    dimples: DefectsSection | None = None
    """Random dimples, in place of amplitude and length; on spheres"""

    _sizes: Mapping[str, Any] = PrivateAttr(default={})

    @model_validator(mode="after")
    def _one_way(self, info: ValidationInfo) -> Self:
        """Check that either a random field or dimples are given, and that dimples have room."""
        is_half_given = (self.amplitude is None) != (self.length is None)
        has_field, has_dimples = self.amplitude is not None, self.dimples is not None
        if is_half_given or has_field == has_dimples:
            raise ValueError("give amplitude and length of a random field, or dimples")
        if self.dimples:
            self._sizes = sizes_noted(info)  # the dimples are validated once more, when drawn
            _ = self.random_dimples  # refuses what has no room
        return self

    def account(self) -> str:
        return f"random field of {self.amplitude:g} h, seed {self.seed}"

    def listed(self) -> Mapping[str, ImperfectionSection]:
        """Return the random dimples by their keys below the section's, or the section itself."""
        if not self.dimples:
            return {"": self}
        return {f".{key}": dimple for key, dimple in self.random_dimples.items()}

    @cached_property
    def random_dimples(self) -> Mapping[str, DimpleSection | GaussianSection]:
        """The random dimples by keys below the section, such as "dimples.0"; empty for a field.

        They are drawn from the seed, once, and validated as sections of the case.
        """
        if self.dimples is None:
            return {}
        # a stream of random numbers of its own: sample 0, with the name of this list
        items = self.dimples.draw(generator(self.seed, 0, "shell.imperfections"))
        section_class = DimpleSection if self.dimples.kind == "dimple" else GaussianSection
        try:
            sections = [
                section_class.model_validate(item, context=dict(self._sizes)) for item in items
            ]
        except ValidationError as e:
            error = e.errors()[0]  # of the first dimple: those of the others are alike
            raise ValueError(
                f"dimples: {error['loc'][-1]}: {error['msg'].removeprefix('Value error, ')}"
            ) from None
        return {f"dimples.{i}": dimple for i, dimple in enumerate(sections)}

    def geometry(self, reference: ReferenceShell, key: str) -> ImperfectionGeometry:
        """Return the geometry of the random field; elements resolve its length of correlation."""
        assert self.amplitude is not None
        assert self.length
        length = half_width(self.length, reference.R_over_h, reference.nu)
        return ImperfectionGeometry(
            RandomWaves(self.amplitude / reference.R_over_h, length, self.seed), length
        )


@dataclass(frozen=True)
class RandomWaves:
    """w0(x) = delta sqrt(2/N) sum_j cos(k_j . x/length + phase_j), k_j normal, phase_j uniform.

    The mean over seeds is zero, the covariance is delta^2 exp(-d^2/(2 length^2)) (Shinozuka and
    Deodatis 1996). The bits of PCG64 are the same on every machine and in every version of NumPy.

    Attributes
    ----------
    delta, length
        Standard deviation and length of correlation, over R.
    seed
        Chooses one of the random fields.
    """

    delta: float
    length: float
    seed: int

    @cached_property
    def _waves(self) -> Array:
        """Array (4, N): three components of k over the length, and the phase (rad)."""
        import scipy

        bits = np.random.PCG64(self.seed).random_raw(4 * WAVE_COUNT).reshape(4, WAVE_COUNT)
        # 53 of the 64 bits, in the middle of their interval: never 0 or 1
        uniform = ((bits >> np.uint64(11)) + 0.5) / 2.0**53
        # three normal numbers by the inverse of their distribution, and a phase, for each wave
        return np.vstack([scipy.special.ndtri(uniform[:3]) / self.length, 2 * np.pi * uniform[3:]])

    def __call__(self, places: Array) -> Array:
        """Return w0 (n,) over R at places (n, 3) over R."""
        w0 = np.empty(len(places))
        # in parts, since the array of places times waves would be large
        for i in range(0, len(places), PLACES_AT_ONCE):
            x = places[i : i + PLACES_AT_ONCE]
            # phase_j + k_j . x/length of each place and wave
            angles = self._waves[3] + sum(x[:, j : j + 1] * self._waves[j] for j in range(3))
            w0[i : i + PLACES_AT_ONCE] = np.cos(angles).sum(axis=1)
        return self.delta * sqrt(2 / WAVE_COUNT) * w0
