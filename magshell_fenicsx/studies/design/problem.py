"""What a design wants, as an objective that is least and constraints that are not negative."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.design import DesignSection
from magshell_fenicsx.simulate.gradients.instabilities import BESIDE, FOLDS, MOST
from magshell_fenicsx.simulate.results import Target
from magshell_fenicsx.studies.design.evaluate import Evaluation
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
        value = found.values[wanted.result]
        scale = self.scale.get(wanted.result, abs(value) or 1.0)
        if wanted.value is not None:
            scale = abs(wanted.value) or scale
            return ((value - wanted.value) / scale) ** 2, 2 * (value - wanted.value) / scale**2
        sign = -1.0 if wanted.maximise else 1.0
        return sign * value / scale, sign / scale

    @property
    def lowest(self) -> bool:
        """Whether the lowest of several instabilities is to be raised."""
        return self.section.objective.maximise in FOLDS

    def lowest_values(self, found: Evaluation) -> Array:
        """(MOST,): the lowest instabilities over their first value; where fewer are near, what is surely above."""
        result = self.section.objective.result
        values = [found.values[result], *(value for value, _ in found.beside[result])]
        return np.array([*values, *[BESIDE * values[0]] * MOST])[:MOST] / self.scale[result]

    def lowest_slopes(self, found: Evaluation) -> Array:
        """(MOST, variables)."""
        result = self.section.objective.result
        slopes = [found.gradients[result], *(slope for _, slope in found.beside[result])]
        return np.array([*slopes, *[[BESIDE * v for v in slopes[0]]] * MOST])[:MOST] / self.scale[result]

    def constraints(self, found: Evaluation) -> Array:
        """Not negative where all are kept."""
        return np.array([sign * (found.values[of] - bound) / scale for of, bound, sign, scale in self._bounds])

    def constraint_slopes(self, found: Evaluation) -> Array:
        """(constraints, variables)."""
        return np.array([sign / scale * np.array(found.gradients[of]) for of, _, sign, scale in self._bounds])

    @property
    def _bounds(self) -> list[tuple[str, float, float, float]]:
        """Result, bound, sense and scale of each."""
        sides = [
            (limit.of, bound, sign)
            for limit in self.section.constraints
            for bound, sign in ((limit.least, 1.0), (limit.most, -1.0))
            if bound is not None
        ]
        return [(of, bound, sign, abs(bound) or self.scale.get(of, 1.0)) for of, bound, sign in sides]

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
        for of, bound, sign, _ in self._bounds:
            if sign * (found.values[of] - bound) < -KEPT * (abs(bound) or 1.0):
                asked = f"{of} {'at least' if sign > 0 else 'at most'} {bound:g} is not kept"
                said.append(f"{asked}: the nearest found is {found.values[of]:.6g}")
        return "; ".join(said)


def problem_of(case: Case, section: DesignSection) -> Problem:
    """What the section of a case wants."""
    shape = section.objective.shape
    if shape is None:
        return Problem(section, {})
    parts = [(i + 1) / shape.stages for i in range(shape.stages)]
    *stages, last = [{"shape": target_of(shape, case, part)} for part in parts]
    return Problem(section, last, stages)
