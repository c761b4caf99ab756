"""Random imperfections from a seed: a smooth field, or dimples at random places."""

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, Self

from pydantic import Field, PrivateAttr, ValidationError, ValidationInfo, model_validator

from magshell_fenicsx.case.imperfections.dimple import DimpleSection
from magshell_fenicsx.case.imperfections.gaussian import GaussianSection
from magshell_fenicsx.input.chance import DefectsSection, generator
from magshell_fenicsx.parts.imperfections.place import ImperfectionSection
from magshell_fenicsx.parts.imperfections.sized import half_width, over, sizes_noted


class RandomSection(ImperfectionSection):
    """A Gaussian random field of a given size and length of correlation, or random dimples.

    The field has the covariance δ² exp(-d²/(2 ℓ²)) of two places at the straight distance d. It and the dimples
    depend on the seed alone, not on mesh, machine or ranks.
    """

    kind: Literal["random"]
    seed: int = Field(ge=0, le=2**63 - 1)
    """Chooses one of the random shapes"""
    amplitude: Annotated[float, over("h")] | None = Field(default=None, ge=-50, le=50)
    """Standard deviation δ of the field [h]"""
    length: Annotated[float, over("width")] | None = Field(default=None, ge=0.05, le=1e3)
    """Length of correlation ℓ of the field, in the unit of a dimple's width"""
    dimples: DefectsSection | None = None
    """Random dimples, in place of amplitude and length; on spheres"""

    _sizes: Mapping[str, Any] = PrivateAttr(default={})

    @model_validator(mode="after")
    def _one_way(self, info: ValidationInfo) -> Self:
        if (self.amplitude is None) != (self.length is None) or (self.amplitude is None) == (self.dimples is None):
            raise ValueError("give amplitude and length of a random field, or dimples")
        if self.dimples:
            self._sizes = sizes_noted(info)
            _ = self.drawn  # refuses what has no room
        return self

    def account(self) -> str:
        return f"random field of {self.amplitude:g} h, seed {self.seed}"

    def correlation_length(self, R_over_h: float, nu: float) -> float:
        """ℓ over R."""
        assert self.length
        return half_width(self.length, R_over_h, nu)

    @cached_property
    def drawn(self) -> Mapping[str, DimpleSection | GaussianSection]:
        """The random dimples by their keys below the section."""
        if self.dimples is None:
            return {}
        items = self.dimples.draw(generator(self.seed, 0, "shell.imperfections"))
        kind = DimpleSection if self.dimples.kind == "dimple" else GaussianSection
        try:
            found = [kind.model_validate(item, context=dict(self._sizes)) for item in items]
        except ValidationError as e:
            first = e.errors()[0]
            raise ValueError(f"dimples: {first['loc'][-1]}: {first['msg'].removeprefix('Value error, ')}") from None
        return {f"dimples.{i}": each for i, each in enumerate(found)}
