"""Scenes of a meridian for other numbers of its case, which share the forms and kernels of one.

Terms take what differs between two cases from the placement and from the parameters of their
densities. So where two models have these alike, one of them serves both: each evaluation puts the
values of its case in place first. Numbers are such values: arrays, for each term in a fixed order.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.scene import Scene, build_meridian_model

Array = NDArray[np.float64]
Numbers = dict[str, list[Array]]  # name of a term -> its numbers


@dataclass
class _NumbersOfForms:
    """The numbers in the forms of a model, by a value p of what they depend on.

    A `SettableNumber`: setting its `value` puts the numbers for this p in place.

    Attributes
    ----------
    places
        Name of a term -> the arrays of the model that its forms read.
    for_values
        p -> the numbers for p, in the order of `places`.
    """

    places: Numbers
    for_values: dict[float, Numbers] = field(default_factory=dict)
    _value: float = np.nan

    @property
    def value(self) -> float:
        """The p whose numbers are in place."""
        return self._value

    @value.setter
    def value(self, value: float) -> None:
        """Put the numbers for another p in place."""
        if value == self._value:
            return
        for name, numbers in self.for_values[value].items():
            for place, number in zip(self.places[name], numbers, strict=True):
                place[...] = number
        self._value = value


class SharedForms:
    """Forms of one meridian that scenes for several values p of a number share.

    The scene that has made them must not be evaluated until the others `leave` them.

    Parameters
    ----------
    scene, model
        The scene that has made the forms, and its model.
    places
        Name of a term -> the arrays of the model that its forms read.

    Attributes
    ----------
    _scene, _model
        This scene and its model.
    _numbers
        The numbers of all scenes, by p. Its p = inf stands for the first scene, as no other scene
        has this p.
    """

    def __init__(self, scene: Scene, model: MeridianModel, places: Numbers) -> None:
        self._scene, self._model = scene, model
        self._numbers = _NumbersOfForms(places, {np.inf: _copied(places)})

    @staticmethod
    def of_scene(scene: Scene) -> "SharedForms | None":
        """Return the forms of a scene; None if other cases would differ in more than numbers."""
        model = scene.model
        if not model.axisymmetric:
            return None
        places = model.numbers()
        return SharedForms(scene, model, places) if places else None

    def scene_at(self, value: float, problem: Problem) -> Scene | None:
        """Return the scene of a problem on the shared forms; None if these do not fit.

        They fit if the numbers of the problem's model have the same shapes.

        Parameters
        ----------
        value
            The p of the problem.
        """
        # a model without forms, which only gives its numbers
        model = build_meridian_model(problem, assembled=False)
        numbers, places = model.numbers(), self._numbers.places
        if numbers is None or _shapes(numbers) != _shapes(places):
            return None
        self._numbers.for_values[value] = _copied(numbers)
        # it has the forms of the first model; each evaluation puts these numbers in place
        shared_model = self._model.with_numbers(model, self._numbers, value)
        return self._scene.with_model(problem, shared_model)

    def leave(self) -> None:
        """Put the numbers of the first scene in place again."""
        self._numbers.value = np.inf


def _shapes(numbers: Numbers) -> list[tuple[str, list[tuple[int, ...]]]]:
    """Return the shapes of the numbers of each term, by name."""
    return [(name, _shapes_in_term(numbers_of_term)) for name, numbers_of_term in numbers.items()]


def _shapes_in_term(numbers_of_term: list[Array]) -> list[tuple[int, ...]]:
    """Return the shapes of the numbers of one term."""
    return [np.shape(number) for number in numbers_of_term]


def _copied(numbers: Numbers) -> Numbers:
    """Return a copy of the numbers of all terms."""
    copies: Numbers = {}
    for name, numbers_of_term in numbers.items():
        copies[name] = [np.array(number) for number in numbers_of_term]
    return copies
