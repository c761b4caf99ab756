"""The waves around the axis, which an axisymmetric model does not see."""

from collections.abc import Sequence
from dataclasses import dataclass

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.continuation.watch import Family
from magshell_fenicsx.models.axisymmetric.waves import Waves


@dataclass(frozen=True)
class WavesOf:
    """The waves of one number m; a `solve.watch.Family`."""

    waves: Waves
    m: int

    @property
    def label(self) -> str:
        return f"m = {self.m}"

    def factor_at(self, state: State) -> Factorisation:
        """Factor their tangent at an axisymmetric state."""
        return self.waves.factor_at(state, self.m)


@dataclass(frozen=True)
class ExcludedWaves:
    """All that are looked at."""

    waves: Waves

    @property
    def families(self) -> Sequence[Family]:
        """For a `Watch`: every number of waves by itself."""
        return [WavesOf(self.waves, m) for m in range(1, self.waves.largest + 1)]

    def counts(self, state: State) -> Sequence[int]:
        """Numbers of unstable directions of all families at a state."""
        return self.waves.counts(state)

    def is_unstable(self, state: State) -> bool:
        """Whether some wave is unstable at an axisymmetric state."""
        return any(self.waves.counts(state))
