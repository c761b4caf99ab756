"""What a design wants, as an objective that is least and constraints that are not negative."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.design import DesignSection
from magshell_fenicsx.simulate.gradients.instabilities import BESIDE, MOST
from magshell_fenicsx.simulate.results import Target
from magshell_fenicsx.studies.design.evaluate import LOWEST, Evaluation
from magshell_fenicsx.studies.design.limits import Limit, limits_of
from magshell_fenicsx.studies.design.target import target_of

Array = NDArray[np.float64]
KEPT = 1e-6  # a constraint counts as kept to this part of its bound
REACHED = 1e-3  # a value counts as reached to this part of it


@dataclass
class Problem:
    """What is wanted; results are scaled with their values at the start.

    Attributes
    ----------
    results
        That of the objective first.
    targets
        Of the wanted shape.
    stages
        Those that come before it.
    """

    section: DesignSection
    targets: Mapping[str, Target]
    stages: Sequence[Mapping[str, Target]] = ()
    scale: dict[str, float] = field(default_factory=dict)

    @property
    def results(self) -> list[str]:
        return self.section.results

    def begin(self, first: Evaluation) -> None:
        """Take the scales."""
        self.scale = {result: abs(value) or 1.0 for result, value in first.values.items()}

    def objective(self, found: Evaluation) -> float:
        """Least is best."""
        return self._objective(found)[0]

    def slope(self, found: Evaluation) -> Array:
        """Its gradient."""
        return self._objective(found)[1] * np.array(found.gradients[self.section.objective.result])

    def _objective(self, found: Evaluation) -> tuple[float, float]:
        wanted = self.section.objective
        value = min(found.values[result] for result in wanted.results)
        scale = self._scale or abs(value) or 1.0
        if wanted.value is not None:
            scale = abs(wanted.value) or scale
            return ((value - wanted.value) / scale) ** 2, 2 * (value - wanted.value) / scale**2
        sign = -1.0 if wanted.maximise else 1.0
        return sign * value / scale, sign / scale

    @property
    def _scale(self) -> float:
        """The largest of the objective's results at the start."""
        return max((self.scale.get(result, 0.0) for result in self.section.objective.results), default=0.0)

    @property
    def lowest(self) -> bool:
        """Whether the lowest of several values is to be raised: of results, instabilities or frequencies."""
        wanted = self.section.objective
        return wanted.maximise is not None and (len(wanted.results) > 1 or wanted.result in LOWEST)

    def lowest_values(self, found: Evaluation) -> Array:
        """All of them over the scale, always as many: where fewer are near, what is surely above."""
        every = [_several(found.values[of], found.beside.get(of)) for of in self.section.objective.results]
        return np.asarray(np.concatenate([[value for value, _ in several] for several in every]) / self._scale)

    def lowest_slopes(self, found: Evaluation) -> Array:
        """(values, variables)."""
        results = self.section.objective.results
        every = [_several(found.values[of], found.beside.get(of), found.gradients[of]) for of in results]
        return np.asarray(np.concatenate([[slope for _, slope in several] for several in every]) / self._scale)

    def constraints(self, found: Evaluation) -> Array:
        """Not negative where all are kept."""
        return np.array([limit.left(found.values) / self._size(limit) for limit in self._limits])

    def constraint_slopes(self, found: Evaluation) -> Array:
        """(constraints, variables)."""
        return np.array([limit.slope(found.gradients) / self._size(limit) for limit in self._limits])

    @property
    def _limits(self) -> list[Limit]:
        """Of all constraints."""
        return [each for section in self.section.constraints for each in limits_of(section, self.scale)]

    def _size(self, limit: Limit) -> float:
        return abs(limit.bound) or max(self.scale.get(of, 0.0) for of in (limit.of, limit.other)) or 1.0

    def violation(self, found: Evaluation) -> float:
        """By how much the constraints are not kept, relative."""
        return float(max([0.0, *(-self.constraints(found))]))

    def merit(self, found: Evaluation) -> tuple[float, float]:
        """By what evaluations are compared: least is best."""
        violation = self.violation(found)
        return (violation if violation > KEPT else 0.0, self.objective(found))

    def words(self, found: Evaluation) -> str:
        """The results of an evaluation."""
        return ", ".join(f"{key} = {value:.6g}" for key, value in (found.values | found.seen).items())

    def missed(self, found: Evaluation) -> str:
        """What is not as wanted; empty if all is."""
        wanted, said = self.section.objective, list[str]()
        if wanted.value is not None and wanted.reach:
            value = found.values[wanted.reach]
            if abs(value - wanted.value) > REACHED * (abs(wanted.value) or 1.0):
                asked = f"{wanted.reach} = {wanted.value:g} is not reached within the bounds"
                said.append(f"{asked}: the nearest found is {value:.6g}")
        for limit in self._limits:
            if limit.left(found.values) < -KEPT * self._size(limit):
                said.append(f"{limit.words} is not kept: the nearest found is {found.values[limit.of]:.6g}")
        return "; ".join(said)


def _several(
    value: float, beside: Sequence[tuple[float, list[float]]] | None, slope: Sequence[float] = ()
) -> list[tuple[float, Sequence[float]]]:
    """A result and those beside it with their slopes: MOST of what may cross others, else one."""
    if beside is None:
        return [(value, slope)]
    above = (BESIDE * value, [BESIDE * v for v in slope])
    return [(value, slope), *beside, *[above] * MOST][:MOST]


def problem_of(case: Case, section: DesignSection) -> Problem:
    """What the section of a case wants."""
    shape = section.objective.shape
    if shape is None:
        return Problem(section, {})
    parts = [(i + 1) / shape.stages for i in range(shape.stages)]
    *stages, last = [{"shape": target_of(shape, case, part)} for part in parts]
    return Problem(section, last, stages)
