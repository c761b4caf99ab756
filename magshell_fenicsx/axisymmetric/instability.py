"""The waves around the axis, which an axisymmetric model does not see."""

from collections.abc import Sequence
from dataclasses import dataclass

from magshell_fenicsx.axisymmetric.waves import Waves
from magshell_fenicsx.solve.factor import Factorisation
from magshell_fenicsx.solve.system import State
from magshell_fenicsx.solve.watch import Family


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
        return bool(self.waves.unstable(state))
