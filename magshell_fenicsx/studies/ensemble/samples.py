"""The samples of an ensemble: cases with drawn values."""

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.chance.places import NoRoom
from magshell_fenicsx.input.source import CaseError, Source, override
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.studies.ensemble.door import in_the_file, refuse_unknown_keys
from magshell_fenicsx.studies.sweep.points import identity

Values = dict[str, Any]


@dataclass(frozen=True)
class Sample:
    """A sample.

    Attributes
    ----------
    number
        From 0.
    values
        Key -> its drawn value; also of the keys of each random defect.
    severest
        Amplitude, width and place of the defect with the largest amplitude; empty without defects.
    key
        Hash of the problem, see `identity`.
    """

    number: int
    values: Values
    severest: Values
    case: Case
    key: str


def make_samples(source: Source, seed: int, numbers: Sequence[int], deleted: int = 0) -> list[Sample]:
    """Draw samples; each is a valid case.

    Parameters
    ----------
    source
        The case file, with its settings applied.
    deleted
        Number of defects to delete from each sample, the ones with the least amplitude.

    Raises
    ------
    CaseError
        If the case has no section `ensemble`, or a sample is no valid case; nothing has been computed then.
    """
    section = Case.from_source(source).ensemble
    if section is None:
        raise CaseError(f"{source.name}: ensemble: is missing: it says which keys are random")
    refuse_unknown_keys(source, section)
    made = []
    for number in numbers:
        drawn = dict[str, str]()
        try:
            drawn = section.settings(seed, number)
            made.append(_sample(source, number, drawn, deleted))
        except (CaseError, NoRoom) as e:
            message = in_the_file(str(e), source, {key: text for key, text in drawn.items() if key in section.keys})
            raise CaseError(f"{message}\nin sample {number} of seed {seed}; bounds keep a distribution in") from None
    return made


def _sample(source: Source, number: int, drawn: dict[str, str], deleted: int) -> Sample:
    here = copy.deepcopy(source)
    del here.data["ensemble"]
    for key, text in drawn.items():
        override(here, f"{key}={text}")
    values, case = dict(_numbers(here.data, drawn)), Case.from_source(here)
    ranked = _defects(here.data, case)
    if deleted:
        if len(ranked) <= deleted:
            raise CaseError(f"--delete-weakest {deleted}: the sample has only {len(ranked)} defects")
        gone = {id(defect) for defect in ranked[:deleted]}
        shell = here.data["shell"]
        shell["imperfections"] = [item for item in shell["imperfections"] if id(item) not in gone]
        case = Case.from_source(here)
    make_plan(case)
    return Sample(number, values, dict(_flat("", ranked[-1])) if ranked else {}, case, identity(case))


def _numbers(data: Any, drawn: dict[str, str]) -> Iterator[tuple[str, Any]]:
    """The drawn keys with their values, of defects each key of each."""
    for key in drawn:
        part = data
        for word in key.split("."):
            part = part[int(word)] if isinstance(part, list) else part[word]
        yield from _flat(key, part)


def _flat(path: str, part: Any) -> Iterator[tuple[str, Any]]:
    """The keys below a part of a case, without kinds; a value itself."""
    if isinstance(part, dict | list):
        for key, value in part.items() if isinstance(part, dict) else enumerate(part):
            if key != "kind":
                yield from _flat(f"{path}.{key}" if path else str(key), value)
    else:
        yield path, part


def _defects(data: Any, case: Case) -> list[dict[str, Any]]:
    """The defects with an amplitude as the case has them, the weakest first; amplitudes with units count over h."""
    shell = data["shell"]
    listed = shell.get("imperfections") or ([shell["defect"]] if shell.get("defect") else [])
    single = getattr(case.shell, "defect", None)
    sections = case.shell.imperfections or ([single] if single else [])
    sizes = [getattr(section, "amplitude", None) for section in sections]
    sized = [(abs(size), item) for size, item in zip(sizes, listed, strict=True) if size is not None]
    return [item for _, item in sorted(sized, key=lambda pair: pair[0])]
