"""A meridian's scene for other numbers of its case: the same forms and kernels, with other values
in place.

Terms take what differs between two cases from the placement and from the parameters of their
densities. So where two models have these alike, one of them serves both: each evaluation puts the
values of its case in place first.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.scene import Scene, build_meridian_model

Array = NDArray[np.float64]
Numbers = dict[str, list[Array]]


@dataclass
class _InPlace:
    """The numbers in the terms of a model, by a value of what they depend on; a `SettableNumber`."""

    places: Numbers
    of_values: dict[float, Numbers] = field(default_factory=dict)
    _value: float = np.nan

    @property
    def value(self) -> float:
        return self._value

    @value.setter
    def value(self, value: float) -> None:
        if value != self._value:
            for name, numbers in self.of_values[value].items():
                for place, number in zip(self.places[name], numbers, strict=True):
                    place[...] = number
            self._value = value


class Renumbered:
    """Scenes that share the forms of one; that one must not be evaluated until they `leave` it.

    Parameters
    ----------
    model
        Of the scene.
    places
        What it has in its `numbers`.
    """

    def __init__(self, scene: Scene, model: MeridianModel, places: Numbers) -> None:
        self._scene, self._model, self._numbers = (
            scene,
            model,
            _InPlace(places, {np.inf: _copied(places)}),
        )

    @staticmethod
    def of(scene: Scene) -> "Renumbered | None":
        """None if what differs between cases is not in numbers alone."""
        model = scene.model
        places = model.numbers() if model.axisymmetric else None
        return Renumbered(scene, model, places) if model.axisymmetric and places else None

    def at(self, value: float, problem: Problem) -> Scene | None:
        """The scene of a problem at a value of what varies; None if its numbers are not in the same
        places.
        """
        model = build_meridian_model(problem, assembled=False)
        numbers, places = model.numbers(), self._numbers.places
        if numbers is None or _shapes(numbers) != _shapes(places):
            return None
        self._numbers.of_values[value] = _copied(numbers)
        return self._scene.renumbered(
            problem, self._model.with_numbers(model, self._numbers, value)
        )

    def leave(self) -> None:
        """Let the scene have its own numbers again."""
        self._numbers.value = np.inf


def _shapes(numbers: Numbers) -> list[tuple[str, list[tuple[int, ...]]]]:
    return [(name, [np.shape(number) for number in each]) for name, each in numbers.items()]


def _copied(numbers: Numbers) -> Numbers:
    return {name: [np.array(number) for number in each] for name, each in numbers.items()}
