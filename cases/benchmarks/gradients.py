"""Every number of some cases: the gradients of their results by it, and differences of whole runs
on the same mesh.

`python3 -m benchmarks.gradients [CASE ...]`, in `cases/`, prints the table of
docs/benchmarks/gradients.md. The keys are all numbers that the sections of a case have, whether
they are written or not.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml
from benchmarks.gradients_cases import CASES, Compared
from pydantic import BaseModel

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.input.section import number_and_unit, si_size
from magshell_fenicsx.input.source import CaseError, Source, override
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint
from magshell_fenicsx.simulate.gradients.gradient import derivative
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, LostResult, instabilities
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end
from magshell_fenicsx.simulate.perturbation import (
    KEYS_WITHOUT_GRADIENT,
    number_at_key,
    scale_at_key,
)
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene_cache import problem_on_mesh_of

STEP, LONG = (
    1e-4,
    1e-3,
)  # of what a change of a number is small against; where it changes the result little
WEAK = 1e-2  # of a result: what a relative change of one changes it by where steps are long
NOTHING = (
    1e-8  # of a result: what a relative change of one changes it by that is rounding of the runs
)


@dataclass(frozen=True)
class Line:
    """A result by a key: its gradient and the difference of whole runs; or why there is none.

    `scale` is what a change of one, relative to the number, changes the result by if it changes it
    by itself.
    """

    key: str
    of: str = ""
    gradient: float = 0.0
    difference: float = 0.0
    scale: float = 0.0
    refused: str = ""

    @property
    def error(self) -> float:
        """Of the gradient over the difference; 0 where both are rounding."""
        if max(abs(self.gradient), abs(self.difference)) <= NOTHING * self.scale:
            return 0.0
        return abs(self.gradient - self.difference) / max(
            abs(self.difference), NOTHING * self.scale
        )


@dataclass
class Ran:
    """A scene at the end of its run."""

    scene: Scene
    records: list[Record]
    history: History

    @classmethod
    def of(cls, problem: Problem) -> "Ran":
        scene, history = Scene(problem), History()
        records = list(follow(scene))
        for record in records:
            history.add(record)
        return cls(scene, records, history)

    def adjoint(self, of: str) -> Adjoint:
        """What contracts the gradients of a result."""
        if of in FOLDS:
            return instabilities(self.scene, self.records, of, 1, self.history.begins)[0][1]
        return adjoint_at_end(self.scene, self.history, of)[1]

    def value(self, of: str) -> float:
        """A result: as a row of path.csv has it, else as it was located."""
        state = self.records[-1].point.state
        row = {**state.mu, **self.scene.observe(state)}
        return float(row[of]) if of in row else self.adjoint(of).value_in_unit


def numbers(part: Any, key: str) -> Iterator[str]:
    """The keys of all numbers of a section."""
    if isinstance(part, BaseModel):
        part = {name: getattr(part, name) for name in type(part).model_fields}
    if isinstance(part, list):
        part = dict(enumerate(part))
    if isinstance(part, Mapping):
        for name, value in part.items():
            yield from numbers(value, f"{key}.{name}")
    elif isinstance(part, int | float) and not isinstance(part, bool):
        yield key


def keys_of(case: Case) -> list[str]:
    """Of all sections that are no target and no mesh."""
    context = case.problem().context
    sections = {
        name: section
        for name, section in context.sections.items()
        if name not in ("imperfections", *KEYS_WITHOUT_GRADIENT)
    }
    return list(
        dict.fromkeys(key for name, section in sections.items() for key in numbers(section, name))
    )


def with_number(text: str, key: str, value: float) -> Problem:
    """The problem of a case file with another number, in the unit that it is written in."""
    source = Source("case", yaml.safe_load(text))
    written = source.data
    for name in key.split("."):
        written = written[int(name)] if isinstance(written, list) else (written or {}).get(name)
        if not isinstance(written, list | dict):
            break
    unit = number_and_unit(written)[1] if isinstance(written, str) else ""
    override(source, f'{key}="{value / si_size(unit)!r} {unit}"' if unit else f"{key}={value!r}")
    return Case.from_source(source).problem()


def compared(compare: Compared, keys: Sequence[str] = ()) -> Iterator[Line]:
    """The lines of a case, of some keys or of all."""
    case = Case.from_source(Source("case", yaml.safe_load(compare.text)))
    ran = Ran.of(case.problem())
    context = ran.scene.problem.context
    adjoints = {of: ran.adjoint(of) for of in compare.results}
    for key in keys or keys_of(case):
        try:
            value, size = number_at_key(context, key), scale_at_key(context, key)
            found = {of: derivative(each, key) for of, each in adjoints.items()}
        except CaseError as e:
            yield Line(key, refused=str(e))
            continue
        yield from _differences(compare, ran, key, value, size, found)
    for name, (key, along) in compare.fields.items():
        found = {of: _along(derivative(each, name), along) for of, each in adjoints.items()}
        yield from (
            Line(f"{name} ({key})", line.of, line.gradient, line.difference, line.scale)
            for line in _differences(compare, ran, key, compare.at.get(key, 1.0), 1.0, found)
        )


def _along(found: Any, along: Any) -> float:
    """The derivative along a field, given by its values at places and normals."""
    assert isinstance(found, FieldGradient)
    return found.along(np.asarray(along(found.places)))


def _differences(
    compare: Compared, ran: Ran, key: str, value: float, size: float, found: Mapping[str, Any]
) -> Iterator[Line]:
    scales = {of: abs(ran.value(of)) / size for of in found}
    step = LONG if any(abs(found[of]) < WEAK * scale for of, scale in scales.items()) else STEP
    try:
        others = [with_number(compare.text, key, value + way * step * size) for way in (-1, 1)]
    except CaseError as e:
        yield Line(key, refused=f"{key}: no other value is allowed: {str(e).rpartition(': ')[-1]}")
        return
    ends = [Ran.of(problem_on_mesh_of(ran.scene, other)) for other in others]
    for of, gradient in found.items():
        low, high = (end.value(of) for end in ends)
        yield Line(key, of, float(gradient), (high - low) / (2 * step * size), scales[of])


def main(names: Sequence[str]) -> None:
    for name in names or CASES:
        print(
            f"\n### {name}\n\n{CASES[name].account}\n\n"
            "| key | result | gradient | difference of runs | error |"
        )
        print("| --- | --- | --- | --- | --- |")
        refused = list[Line]()
        try:
            for line in compared(CASES[name]):
                if line.refused:
                    refused.append(line)
                    continue
                numbers = f"{line.gradient:.8g} | {line.difference:.8g} | {line.error:.0e}"
                print(f"| `{line.key}` | {line.of} | {numbers} |", flush=True)
        except LostResult as e:
            print(f"lost: {e}")
        print("\nRefused:\n")
        for line in refused:
            print(f"- {line.refused}")


if __name__ == "__main__":
    main(sys.argv[1:])
