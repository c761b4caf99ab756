"""The search for further solutions at the end of a step."""

from typing import Annotated

from pydantic import Field

from magshell_fenicsx.input.section import Section


class SearchSection(Section):
    """Other equilibria at the last point of a step, such as snapped shapes, by deflation: no path leads to them.

    Everything that the step holds stays held. What is found depends on the guesses: there may be more.
    """

    solutions: Annotated[int, Field(ge=1, le=100)] = 3
    """Ends after so many, each a point with the label solution"""
    guesses: Annotated[int, Field(ge=1, le=1000)] = 12
    """Guesses tried at most: the shell with dents, then both directions of the softest mode of each solution"""
    stable: bool = False
    """Whether each guess goes down in energy until it rests at a stable solution, which takes minutes on surfaces; only
    stable ones count. A half or a meridian knows no motions beside its symmetry: take symmetry: none"""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """No guess is tried after so long; by default there is no limit [s]"""
