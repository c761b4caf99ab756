"""The samples of an ensemble: cases with drawn values."""

import copy
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from magshell_fenicsx.input.chance import NoRoom
from magshell_fenicsx.input.messages import InvalidCase
from magshell_fenicsx.input.source import CaseError, Source, override
from magshell_fenicsx.studies.points import identity, value_at
from magshell_fenicsx.studies.runner import Case, MakeCase
from magshell_fenicsx.studies.sections import EnsembleSection

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


def make_samples(
    source: Source, seed: int, numbers: Sequence[int], make_case: MakeCase, deleted: int = 0
) -> list[Sample]:
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
        If the case has no section `ensemble`, or a sample is no valid case; nothing has been
        computed then.
    """
    section = make_case(source).ensemble
    if section is None:
        raise CaseError(f"{source.name}: ensemble: is missing: it says which keys are random")
    shells = list(source.data.get("shells") or ())
    try:
        section.refuse_unfit(shells)
    except ValueError as e:
        raise CaseError(str(e)) from None
    refuse_unknown_keys(source, section, make_case)
    samples = []
    for number in numbers:
        drawn_texts = dict[str, str]()
        try:
            drawn_texts = section.settings(seed, number, shells)
            samples.append(_sample(source, number, drawn_texts, make_case, deleted))
        except (CaseError, NoRoom) as e:
            message = in_the_file(
                str(e),
                source,
                {key: text for key, text in drawn_texts.items() if key in section.keys},
            )
            raise CaseError(
                f"{message}\nin sample {number} of seed {seed}; bounds keep a distribution in"
            ) from None
    return samples


def _sample(
    source: Source, number: int, drawn_texts: Mapping[str, str], make_case: MakeCase, deleted: int
) -> Sample:
    drawn_source = copy.deepcopy(source)
    del drawn_source.data["ensemble"]
    for key, text in drawn_texts.items():
        override(drawn_source, f"{key}={text}")
    values = {
        path: value
        for key in drawn_texts
        for path, value in _flat(key, value_at(drawn_source.data, key.split(".")))
    }
    case = make_case(drawn_source)
    ranked = _defects(drawn_source.data, case)
    if deleted:
        if len(ranked) <= deleted:
            raise CaseError(
                f"--delete-weakest {deleted}: the sample has only {len(ranked)} defects"
            )
        deleted_ids = {id(defect) for defect in ranked[:deleted]}
        for shell, _ in _shells(drawn_source.data, case):
            if "imperfections" in shell:
                shell["imperfections"] = [
                    item for item in shell["imperfections"] if id(item) not in deleted_ids
                ]
        case = make_case(drawn_source)
    case.problem()
    return Sample(
        number, values, dict(_flat("", ranked[-1])) if ranked else {}, case, identity(case)
    )


def _flat(path: str, part: Any) -> Iterator[tuple[str, Any]]:
    """The keys below a part of a case, without kinds; a value itself."""
    if isinstance(part, dict | list):
        for key, value in part.items() if isinstance(part, dict) else enumerate(part):
            if key != "kind":
                yield from _flat(f"{path}.{key}" if path else str(key), value)
    else:
        yield path, part


def _defects(data: Any, case: Case) -> list[dict[str, Any]]:
    """The defects with an amplitude as the case has them, the weakest first; amplitudes with units
    count over h.
    """
    sized = list[tuple[float, dict[str, Any]]]()
    for shell, section in _shells(data, case):
        listed = shell.get("imperfections") or ([shell["defect"]] if shell.get("defect") else [])
        single = getattr(section, "defect", None)
        sections = section.imperfections or ([single] if single else [])
        sizes = [getattr(section_of_defect, "amplitude", None) for section_of_defect in sections]
        sized += [
            (abs(size), item) for size, item in zip(sizes, listed, strict=True) if size is not None
        ]
    return [item for _, item in sorted(sized, key=lambda pair: pair[0])]


def _shells(data: Any, case: Case) -> list[tuple[dict[str, Any], Any]]:
    """The data and the section of each shell."""
    if case.shells:
        return [
            (data["shells"][name]["shell"], member.shell) for name, member in case.shells.items()
        ]
    return [(data["shell"], case.shell)]


# errors of pydantic about keys, which no value drawn can mend
OF_KEYS = ("extra_forbidden", "model_type", "model_attributes_type", "list_type", "dict_type")


def refuse_unknown_keys(source: Source, section: EnsembleSection, make_case: MakeCase) -> None:
    """Refuse random keys that the case cannot have, whatever their values: before any sample is
    drawn.

    Raises
    ------
    CaseError
        One message with every such key.
    """
    middle, refused = (
        {key: json.dumps(distribution.quantile(0.5)) for key, distribution in section.keys.items()},
        list[str](),
    )
    changed = copy.deepcopy(source)
    del changed.data["ensemble"]
    for key, text in middle.items():
        try:
            override(changed, f"{key}={text}")
        except CaseError as e:
            refused.append(str(e))
    try:
        make_case(changed)
    except InvalidCase as e:
        refused += e.lines_of_kinds(*OF_KEYS)
    except CaseError:
        pass  # a matter of the values
    if refused:
        raise CaseError(in_the_file("\n".join(refused), source, middle))


def in_the_file(message: str, source: Source, drawn_texts: Mapping[str, str]) -> str:
    """A message about settings that were drawn, with the places of their distributions."""
    for key, text in drawn_texts.items():
        place = f"{source.place(('ensemble', 'keys', key))}: ensemble.keys: "
        message = message.replace(f"--set {key}={text}: {key}: ", f"{place}{key}: ")
        message = message.replace(f"--set {key}={text}: ", f"{place}{key}: ")
    return message
