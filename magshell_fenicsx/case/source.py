"""Reading a case file: YAML to plain data, with the line of every key kept for messages."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

Location = tuple[str | int, ...]


class CaseError(ValueError):
    """The user's input cannot be used; the message says what and where."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """YAML 1.1 reads 1e-3 as a string; here it is a number, as in YAML 1.2."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"),
    list("-+0123456789."),
)


@dataclass
class Source:
    """Plain data with the place that each key came from.

    Attributes
    ----------
    places
        Location of a key -> "file:line" or the `--set` that gave it.
    """

    name: str
    data: dict[str, Any]
    places: dict[Location, str] = field(default_factory=dict)

    def place(self, location: Location) -> str:
        """The place of a key, or of the innermost section around it."""
        for length in range(len(location), 0, -1):
            if location[:length] in self.places:
                return self.places[location[:length]]
        return self.name


def read_source(file: Path) -> Source:
    """Read a case file.

    Raises
    ------
    CaseError
        If the file cannot be read, is no YAML mapping, or has a key twice.
    """
    try:
        text = file.read_text(encoding="utf-8")
        node = yaml.compose(text, Loader=_Loader)
    except OSError as e:
        raise CaseError(f"{file}: cannot be read: {e.strerror}") from None
    except UnicodeDecodeError:
        raise CaseError(f"{file}: is not a text file in UTF-8") from None
    except yaml.YAMLError as e:
        mark = getattr(e, "problem_mark", None)
        where = f"{file}:{mark.line + 1}" if mark else f"{file}"
        raise CaseError(f"{where}: not valid YAML: {getattr(e, 'problem', None) or getattr(e, 'reason', e)}") from None
    source = Source(str(file), {})
    if not isinstance(node, yaml.MappingNode):
        raise CaseError(f"{file}: a case file is a mapping of sections (shell, boundary, loading, ...)")
    _walk(node, (), source)
    try:
        source.data = _Loader(text).get_single_data()
    except (yaml.YAMLError, ValueError) as e:
        raise CaseError(f"{file}: not valid YAML: {e}") from None
    return source


def _walk(node: yaml.Node, location: Location, source: Source) -> None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            place = f"{source.name}:{key.start_mark.line + 1}"
            if not isinstance(key, yaml.ScalarNode):
                raise CaseError(f"{place}: a key must be a word")
            here = (*location, key.value)
            if here in source.places:
                raise CaseError(f"{place}: {dotted(here)} is given twice")
            source.places[here] = place
            _walk(value, here, source)
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            _walk(value, (*location, i), source)


def override(source: Source, assignment: str) -> None:
    """Apply one `key.path=value` of the command line.

    Raises
    ------
    CaseError
        If it is not of that form, or a key on the way is not a section.
    """
    path, equals, text = assignment.partition("=")
    if not equals or not path.strip():
        raise CaseError(f"--set {assignment}: write it as key.path=value, for example --set mesh.degree=3")
    keys = path.strip().split(".")
    section = source.data
    for key in keys[:-1]:
        section = section.setdefault(key, {})
        if not isinstance(section, dict):
            raise CaseError(f"--set {assignment}: {key} is a value, not a section")
    try:
        section[keys[-1]] = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as e:
        raise CaseError(f"--set {assignment}: not a valid value: {getattr(e, 'problem', e)}") from None
    for length in range(1, len(keys) + 1):
        if length == len(keys) or tuple(keys[:length]) not in source.places:
            source.places[tuple(keys[:length])] = f"--set {assignment}"


def dotted(location: Location) -> str:
    """shell.defect.width"""
    return ".".join(str(key) for key in location)
