"""The section `ensemble` of a case: what is random.

A key is a path of words with dots into the case. A sample of an ensemble is a case with drawn
values.
"""

import json
from collections.abc import Collection
from typing import Annotated, Any, Self

from pydantic import Discriminator, Field, Tag, model_validator

from magshell_fenicsx.input.chance import DefectsSection, Distribution, Value, generator
from magshell_fenicsx.input.section import Section


class PlacedDefectsSection(DefectsSection):
    """Random defects in place of `shell.imperfections`, at random places of a sphere, uniform in
    area.
    """

    on: str | None = None
    """Name of one of several shells, over whose thickness they are; by default each has as many of
    its own
    """


IMPERFECTIONS = "shell.imperfections"


class EnsembleSection(Section):
    """What is random in the samples of `magshell ensemble`; every other command takes the case
    without it.
    """

    keys: dict[str, Distribution] = Field(default_factory=dict)
    """Key of the case, with dots (`magnetic.lambda_m`, `shell.imperfections.0.amplitude`) -> its
    distribution
    """
    defects: (
        Annotated[
            Annotated[PlacedDefectsSection, Tag("one")]
            | Annotated[list[PlacedDefectsSection], Tag("several"), Field(min_length=1)],
            Discriminator(lambda data: "several" if isinstance(data, list) else "one"),
        ]
        | None
    ) = None
    """Random defects of a sphere, or a list of these: for different shells, or of different kinds
    """

    @model_validator(mode="after")
    def _something_is_random(self) -> Self:
        """Check that something is random, and that no key is one that random defects replace."""
        if not self.keys and self.defects is None:
            raise ValueError("needs keys or defects: otherwise nothing is random")
        # where random defects are put; None among the shells means all of them
        reserved_keys = tuple(
            f"shells.{shell_name}.{IMPERFECTIONS}" if shell_name else IMPERFECTIONS
            for shell_name in self._shells_with_defects
        )
        on_all_shells = None in self._shells_with_defects
        for key in self.keys:
            is_of_shell_with_defects = on_all_shells and f".{IMPERFECTIONS}" in key
            if key.startswith(reserved_keys) or is_of_shell_with_defects:
                raise ValueError(f"keys: {key}: defects take the place of shell.imperfections")
        return self

    @property
    def _listed(self) -> list[PlacedDefectsSection]:
        """The sections of random defects, as a list."""
        if isinstance(self.defects, list):
            return self.defects
        return [self.defects] if self.defects else []

    @property
    def _shells_with_defects(self) -> list[str | None]:
        """Names of the shells with random defects; None for defects on all shells."""
        return [defects.on for defects in self._listed]

    def refuse_unfit(self, shells: Collection[str]) -> None:
        """Check that the case has the shells on which defects are.

        Raises
        ------
        ValueError
            If there are no several shells, or none of that name.
        """
        for name in self._shells_with_defects:
            if name and not shells:
                raise ValueError("ensemble.defects.on: names one of several shells: leave it out")
            if name and name not in shells:
                raise ValueError(
                    f"ensemble.defects.on: {name}: there is no such shell, only {', '.join(shells)}"
                )

    def settings(self, seed: int, number: int, shells: Collection[str] = ()) -> dict[str, str]:
        """Draw a sample: return key -> value as JSON text, as in `--set`.

        The values depend on seed and number of the sample alone. Every key has random numbers of
        its own, so a further key does not change the others. The first shell with defects has the
        same defects as if it were alone.

        Parameters
        ----------
        number
            Number of the sample, from 0.
        shells
            Names of several shells.

        Raises
        ------
        NoRoom
            If no places were found for the defects.
        """
        drawn_values: dict[str, Value | list[Any]] = {
            key: distribution.draw(generator(seed, number, key))
            for key, distribution in self.keys.items()
        }
        defects = dict[str, list[Any]]()
        # every section with the name of its shell; "" is the only shell of a case
        defects_by_shell = [
            (defect_section, name)
            for defect_section in self._listed
            for name in ([defect_section.on] if defect_section.on else [*shells] or [""])
        ]
        for i, (defect_section, name) in enumerate(defects_by_shell):
            key = f"shells.{name}.{IMPERFECTIONS}" if name else IMPERFECTIONS
            earlier_count = sum(other_name == name for _, other_name in defects_by_shell[:i])
            # random numbers: the first section has those of a single shell, each other one its own
            if i == 0:
                generator_key = IMPERFECTIONS
            elif earlier_count:  # a further section on this shell
                generator_key = f"{key}.{earlier_count}"
            else:
                generator_key = key
            defects.setdefault(key, []).extend(
                defect_section.draw(generator(seed, number, generator_key))
            )
        drawn_values |= defects
        return {key: json.dumps(value) for key, value in drawn_values.items()}
