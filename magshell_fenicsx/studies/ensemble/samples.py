"""The samples of an ensemble: cases with drawn values.

A value is drawn for each random key of the case, and for all keys of random defects, which replace
the shell's imperfections. Plain data are those of the case file; a section is their validated form.
The weakest defect has the least amplitude.
"""

import copy
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from magshell_fenicsx.input.chance import NoRoom
from magshell_fenicsx.input.messages import InvalidCase
from magshell_fenicsx.input.source import CaseError, Source, override
from magshell_fenicsx.studies.ensemble.sections import EnsembleSection
from magshell_fenicsx.studies.points import Case, MakeCase, identity, value_at

Values = dict[str, Any]


@dataclass(frozen=True)
class Sample:
    """A random sample of a case.

    Attributes
    ----------
    number
        Number of the sample, from 0.
    values
        Key -> its drawn value; also of the keys of each random defect.
    severest
        Amplitude, width and place of the defect with the largest amplitude; empty without defects.
    case
        The validated case.
    key
        Hash of the problem.
    """

    number: int
    values: Values
    severest: Values
    case: Case
    key: str

    @property
    def label(self) -> str:
        """The number in words."""
        return f"sample {self.number}"


def make_samples(
    source: Source, seed: int, numbers: Sequence[int], make_case: MakeCase, deleted: int = 0
) -> list[Sample]:
    """Draw samples; each is a valid case.

    Parameters
    ----------
    source
        The case file, with its settings applied.
    numbers
        Numbers of the samples, from 0; a sample depends on the seed and its number alone.
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
    shells = list(source.data.get("shells") or ())  # names of several shells
    try:
        section.refuse_unfit(shells)  # defects must be on shells of the case
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
            # messages about random keys tell where the case file has their distributions
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
    """Make a sample from its drawn values.

    Parameters
    ----------
    drawn_texts
        Key -> drawn value, as in `--set`.
    deleted
        Number of the weakest defects that are deleted.

    Raises
    ------
    CaseError
        If it is no valid case, or has no more defects than are deleted.
    """
    drawn_source = copy.deepcopy(source)
    del drawn_source.data["ensemble"]
    for key, text in drawn_texts.items():
        override(drawn_source, f"{key}={text}")
    # a drawn section, as of a defect, has a key for each of its numbers
    values = {
        path: value
        for key in drawn_texts
        for path, value in _flat(key, value_at(drawn_source.data, key.split(".")))
    }
    case = make_case(drawn_source)
    ranked = _defects(drawn_source.data, case)  # the weakest first
    if deleted:
        if len(ranked) <= deleted:
            raise CaseError(
                f"--delete-weakest {deleted}: the sample has only {len(ranked)} defects"
            )
        # removed by identity, as two defects may be equal; `_defects` has the items of the data
        deleted_ids = {id(defect) for defect in ranked[:deleted]}
        for shell, _ in _shells(drawn_source.data, case):
            if "imperfections" in shell:
                shell["imperfections"] = [
                    item for item in shell["imperfections"] if id(item) not in deleted_ids
                ]
        case = make_case(drawn_source)
    case.problem()  # raises errors of the case
    severest = dict(_flat("", ranked[-1])) if ranked else {}
    return Sample(number, values, severest, case, identity(case))


def _flat(path: str, part: Any) -> Iterator[tuple[str, Any]]:
    """Yield key and value of all numbers and words in a part of a case, without kinds.

    Parameters
    ----------
    path
        Key of the part, with dots.
    part
        A section, a list or a value.
    """
    if isinstance(part, dict | list):
        for key, value in part.items() if isinstance(part, dict) else enumerate(part):
            if key != "kind":
                yield from _flat(f"{path}.{key}" if path else str(key), value)
    else:
        yield path, part


def _defects(data: Any, case: Case) -> list[dict[str, Any]]:
    """Return the defects with an amplitude as plain data of the case, the weakest first.

    They are ordered by their amplitudes over h, which the sections have, so amplitudes with units
    can be compared.
    """
    sizes_and_defects = list[tuple[float, dict[str, Any]]]()
    for shell, section in _shells(data, case):
        # data, and sections, of the imperfections; the key `defect` is short for a single one
        defects = shell.get("imperfections") or ([shell["defect"]] if shell.get("defect") else [])
        single_defect = getattr(section, "defect", None)
        sections = section.imperfections or ([single_defect] if single_defect else [])
        sizes = [getattr(section_of_defect, "amplitude", None) for section_of_defect in sections]
        sizes_and_defects += [
            (abs(size), item) for size, item in zip(sizes, defects, strict=True) if size is not None
        ]
    return [item for _, item in sorted(sizes_and_defects, key=lambda pair: pair[0])]


def _shells(data: Any, case: Case) -> list[tuple[dict[str, Any], Any]]:
    """Return pairs of the plain data of each shell of the case, and of its section."""
    if case.shells:  # several
        return [
            (data["shells"][name]["shell"], member.shell) for name, member in case.shells.items()
        ]
    return [(data["shell"], case.shell)]


# errors of pydantic about keys, which no value drawn can mend
OF_KEYS = ("extra_forbidden", "model_type", "model_attributes_type", "list_type", "dict_type")


def refuse_unknown_keys(source: Source, section: EnsembleSection, make_case: MakeCase) -> None:
    """Check, before any sample is drawn, that the case can have the random keys.

    The case is tried with the medians. Errors about values do not count.

    Raises
    ------
    CaseError
        One message with every such key.
    """
    medians = {
        key: json.dumps(distribution.quantile(0.5)) for key, distribution in section.keys.items()
    }
    messages = list[str]()
    source_with_medians = copy.deepcopy(source)
    del source_with_medians.data["ensemble"]
    for key, text in medians.items():
        try:
            override(source_with_medians, f"{key}={text}")
        except CaseError as e:
            messages.append(str(e))
    try:
        make_case(source_with_medians)
    except InvalidCase as e:
        messages += e.lines_of_kinds(*OF_KEYS)
    except CaseError:
        pass  # of the medians, not of the keys
    if messages:
        raise CaseError(in_the_file("\n".join(messages), source, medians))


def in_the_file(message: str, source: Source, drawn_texts: Mapping[str, str]) -> str:
    """Return a message about drawn settings with the places of their distributions.

    Parameters
    ----------
    drawn_texts
        Key -> drawn value, as in `--set`.
    """
    for key, text in drawn_texts.items():
        place = f"{source.place(('ensemble', 'keys', key))}: ensemble.keys: "
        message = message.replace(f"--set {key}={text}: {key}: ", f"{place}{key}: ")
        message = message.replace(f"--set {key}={text}: ", f"{place}{key}: ")
    return message
