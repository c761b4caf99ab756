"""Modes of the perfect shell as imperfections."""

from collections.abc import Callable
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from magshell_fenicsx.input.file import FileKeys
from magshell_fenicsx.parts.imperfections.place import ImperfectionSection
from magshell_fenicsx.parts.imperfections.sized import over

Shape = Callable[[NDArray[np.float64]], NDArray[np.float64]]


class ModesSection(FileKeys, ImperfectionSection):
    """The lowest modes of the perfect shell where it first becomes unstable under the case's loads.

    A pressure goes on to there, whatever its target; under other loads without an instability they are those at the
    end. Of each its displacement along the normal, inwards positive, over the largest one.
    """

    kind: Literal["modes"]
    amplitudes: Annotated[list[Annotated[float, over("h"), Field(ge=-50, le=50)]], Field(min_length=1, max_length=20)]
    """Largest w0 of each mode, the lowest mode first; positive: inwards where the mode is largest [h]"""
    file: str | None = None
    """A mode file of a run (fields/mode_*.vtu), its path from the folder of the case, in place of computed modes"""

    _shapes: tuple[Shape, ...] | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _one_mode_in_a_file(self) -> Self:
        if self.file is not None and len(self.amplitudes) > 1:
            raise ValueError(
                "amplitudes: a file has one mode: give one amplitude, and an item of the list for each file"
            )
        return self

    def account(self) -> str:
        return f"modes of {', '.join(f'{a:g}' for a in self.amplitudes)} h"

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"amplitudes.{i}" for i in range(len(self.amplitudes)))

    @property
    def shapes(self) -> tuple[Shape, ...] | None:
        """The modes as functions of places over R, 1 where inwards largest; None until they are computed."""
        return self._shapes

    def become(self, shapes: tuple[Shape, ...]) -> None:
        """Take the modes of the perfect shell."""
        self._shapes = shapes[: len(self.amplitudes)]
