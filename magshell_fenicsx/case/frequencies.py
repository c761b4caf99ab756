"""Natural frequencies: how many, and where on the path."""

from typing import Annotated, Literal

from pydantic import Discriminator, Field, Tag

from magshell_fenicsx.input.section import Section

At = Annotated[
    Annotated[Literal["ends", "end", "all"], Tag("a word")]
    | Annotated[list[Annotated[int, Field(ge=0)]], Tag("points"), Field(min_length=1)],
    Discriminator(lambda data: "points" if isinstance(data, list) else "a word"),
]


class FrequenciesSection(Section):
    """Natural frequencies of small vibrations about points of the path, under the loads of each point.

    frequencies.csv lists ω² ρ R²/E, negative where the shell is unstable, and with `shell.density` hertz.
    """

    count: int = Field(default=6, ge=1, le=50)
    """How many of the lowest; every unstable one is listed besides"""
    at: At = "ends"
    """At which points: the start and the end of the path, the end, all, or numbers of points in path.csv"""
