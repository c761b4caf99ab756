"""The section of an ensemble: what is random."""

import json
import zlib
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from magshell_fenicsx.case.chance.distribution import Distribution, Value
from magshell_fenicsx.case.chance.places import NoRoom, random_places, refuse_no_room
from magshell_fenicsx.input.section import Section

Angle = Annotated[float, Field(ge=0, le=180)]


class DefectsSection(Section):
    """Random defects in place of `shell.imperfections`, at random places of a sphere, uniform in area."""

    kind: Literal["gaussian", "dimple"] = "gaussian"
    """The kind of all of them, as in `shell.imperfections`"""
    count: Distribution
    """Their number; a distribution of whole numbers, or a number"""
    amplitude: Distribution
    """The amplitude of each [h]"""
    width: Distribution
    """The width of each, as in `shell.imperfections`"""
    polar: Annotated[list[Angle], Field(min_length=2, max_length=2)]
    """Least and largest polar angle of their centres [degrees]"""
    distance: Angle = 0.0
    """Least angle between two centres [degrees]"""

    @model_validator(mode="after")
    def _there_is_room(self) -> Self:
        if self.polar[0] >= self.polar[1]:
            raise ValueError(f"polar: the first angle must be less than the second, here {self.polar}")
        numbers = [self.count.at(part) for part in np.linspace(0, 1 - 1e-9, 101)]
        if any(not float(n).is_integer() or not 0 <= float(n) <= 500 for n in numbers if not isinstance(n, str)):
            raise ValueError("count: must be whole numbers from 0 to 500")
        refuse_no_room(max(int(n) for n in numbers), (self.polar[0], self.polar[1]), self.distance)
        return self

    def draw(self, rng: np.random.Generator) -> list[dict[str, Any]]:
        """Defects as in `shell.imperfections`.

        Raises
        ------
        NoRoom
            If no places were found for them.
        """
        count = int(self.count.draw(rng))
        places = random_places(rng, count, (self.polar[0], self.polar[1]), self.distance)
        return [
            {
                "kind": self.kind,
                "amplitude": self.amplitude.draw(rng),
                "width": self.width.draw(rng),
                "at": {"polar": float(polar), "azimuth": float(azimuth)},
            }
            for polar, azimuth in places
        ]


class EnsembleSection(Section):
    """What is random in the samples of `magshell ensemble`; every other command takes the case without it."""

    keys: dict[str, Distribution] = Field(default_factory=dict)
    """Key of the case, with dots (`magnetic.lambda_m`, `shell.imperfections.0.amplitude`) -> its distribution"""
    defects: DefectsSection | None = None
    """Random defects of a sphere"""

    @model_validator(mode="after")
    def _something_is_random(self) -> Self:
        if not self.keys and self.defects is None:
            raise ValueError("needs keys or defects: otherwise nothing is random")
        if self.defects and (key := next((key for key in self.keys if key.startswith("shell.imperfections")), None)):
            raise ValueError(f"keys: {key}: defects take the place of shell.imperfections")
        return self

    def settings(self, seed: int, number: int) -> dict[str, str]:
        """The keys of a sample and their values, as in `--set`; they depend on seed and number alone.

        Every key has random numbers of its own: another key more does not change the others.

        Raises
        ------
        NoRoom
            If no places were found for the defects.
        """
        drawn: dict[str, Value | list[Any]] = {
            key: distribution.draw(generator(seed, number, key)) for key, distribution in self.keys.items()
        }
        if self.defects:
            drawn["shell.imperfections"] = self.defects.draw(generator(seed, number, "shell.imperfections"))
        return {key: json.dumps(value) for key, value in drawn.items()}


def generator(seed: int, number: int, name: str) -> np.random.Generator:
    """The random numbers of a sample for one name."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number, zlib.crc32(name.encode()))))


__all__ = ["DefectsSection", "EnsembleSection", "NoRoom"]
