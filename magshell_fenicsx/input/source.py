"""Reading a case file: YAML to plain data, with the line of every key kept for messages.

A location is the sequence of keys and list positions that lead to a value; its place is the file
and line, or the setting "--set key=value" of the command line that gave it. A node is a part of the
YAML text with its line, before it becomes data.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from errno import EFBIG
from pathlib import Path
from typing import Any

import yaml

from magshell_fenicsx.platform.input_files import Files, read_bounded

Location = tuple[str | int, ...]
# Key of a setting -> the key beside it that it replaces.
REPLACED_KEYS: dict[Location, str] = {("shell", "imperfections"): "defect"}
MERGE = "tag:yaml.org,2002:merge"  # of the key <<

# Far beyond any case.
MAX_CASE_BYTES = 1_000_000
MAX_ENTRIES = 10_000  # keys and items
MAX_DEPTH = 20  # levels


class CaseError(ValueError):
    """Error that the user's input cannot be used; the message says what and where."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Loader of YAML 1.1 that reads 1e-3 as a number, as YAML 1.2 does, and each key as text.

    Without this, 1e-3 would be text, and the keys `on` and `no` would be truth values.
    """

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Return the mapping of a node, with all of its keys as text but for the merge key <<."""
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.tag != MERGE:
                key.tag = "tag:yaml.org,2002:str"
        return dict(super().construct_mapping(node, deep))


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(
        r"^[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?$|^[-+]?\.(inf|Inf|INF)$|^\.(nan|NaN|NAN)$"
    ),
    list("-+0123456789."),
)


@dataclass
class Source:
    """Plain data of a case with the place where each key was written.

    Attributes
    ----------
    name
        Name of the file, for messages.
    data
        The data of the file.
    places
        Location (keys that lead to a key or item) -> "file:line", or the `--set` that gave it.
    folder
        Folder from which the case names files.
    files
        Contents of these files, each read once.
    """

    name: str
    data: dict[str, Any]
    places: dict[Location, str] = field(default_factory=dict)
    folder: Path = field(default_factory=Path)
    files: Files = field(default_factory=Files, compare=False)

    def place(self, location: Location) -> str:
        """Return the place where a key was written, or the innermost section around it."""
        for length in range(len(location), 0, -1):
            if location[:length] in self.places:
                return self.places[location[:length]]
        return self.name


def read_source(file: Path, settings: Sequence[str] = ()) -> Source:
    """Read a case file, and replace values in it by settings such as "mesh.degree=3".

    Raises
    ------
    CaseError
        If the file cannot be read, is no YAML mapping, or has a key twice, or if a setting has no
        equals sign or no such key.
    """
    try:
        text = read_bounded(file, MAX_CASE_BYTES).decode("utf-8")
    except OSError as e:
        if e.errno != EFBIG:
            raise CaseError(f"{file}: cannot be read: {e.strerror}") from None
        raise CaseError(
            f"{file}: is larger than {MAX_CASE_BYTES} bytes, too large for a case file"
        ) from None
    except UnicodeDecodeError:
        raise CaseError(f"{file}: is not a text file in UTF-8") from None
    source = Source(str(file), {}, folder=file.parent.absolute())
    # the text is parsed twice: nodes have the lines of keys, and data have merged keys (<<)
    root_node = _parsed(source, lambda: yaml.compose(text, Loader=_Loader))
    if not isinstance(root_node, yaml.MappingNode):
        raise CaseError(
            f"{file}: a case file is a mapping of sections (shell, boundary, loading, ...)"
        )
    _note_places(root_node, (), source)
    data = _parsed(source, lambda: _Loader(text).get_single_data())
    if not isinstance(data, dict):  # an explicit tag can make anything of a mapping
        raise CaseError(
            f"{file}: a case file is a mapping of sections (shell, boundary, loading, ...)"
        )
    source.data = data
    for setting in settings:
        override(source, setting)
    return source


def _parsed(source: Source, parse: Callable[[], Any]) -> Any:
    """Return the result of `parse`, a call of PyYAML without arguments.

    Raises
    ------
    CaseError
        With the line, if PyYAML fails in one of its many ways.
    """
    try:
        return parse()
    except yaml.YAMLError as e:
        error_mark = getattr(e, "problem_mark", None)
        place = f"{source.name}:{error_mark.line + 1}" if error_mark else source.name
        problem = getattr(e, "problem", None) or getattr(e, "reason", e)
        raise CaseError(f"{place}: not valid YAML: {problem}") from None
    except RecursionError:
        raise CaseError(f"{source.name}: not valid YAML: it is nested too deeply") from None
    except Exception as e:
        # A value that does not fit its explicit tag, such as !!timestamp or !!int.
        raise CaseError(f"{source.name}: not valid YAML: {type(e).__name__}: {e}") from None


def _note_places(node: yaml.Node, location: Location, source: Source) -> None:
    """Note the places of all keys and items of a node in `source.places`.

    Parameters
    ----------
    location
        Keys that lead to the node.

    Raises
    ------
    CaseError
        If a key is given twice or is no word, or the data are endless, as aliases can make them.
    """
    if len(source.places) > MAX_ENTRIES or len(location) > MAX_DEPTH:
        raise CaseError(
            f"{source.name}:{node.start_mark.line + 1}: more than {MAX_ENTRIES} entries, or deeper "
            f"than {MAX_DEPTH} levels, are no case file (does an alias hold itself?)"
        )
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            place = f"{source.name}:{key.start_mark.line + 1}"
            if not isinstance(key, yaml.ScalarNode) or not key.value.isprintable():
                raise CaseError(f"{place}: a key must be a word")
            inner = (*location, key.value)
            if inner in source.places:
                raise CaseError(f"{place}: {dotted(inner)} is given twice")
            source.places[inner] = place
            _note_places(value, inner, source)
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            source.places[*location, i] = f"{source.name}:{value.start_mark.line + 1}"
            _note_places(value, (*location, i), source)


def override(source: Source, assignment: str) -> None:
    """Apply a setting "key.path=value" of the command line to the data of a case.

    A setting of a key also removes the key beside it that it replaces: shell.imperfections replaces
    shell.defect.

    Raises
    ------
    CaseError
        If the text has another form, or a key on the way is not a section.
    """
    path, equals, text = assignment.partition("=")
    if not equals or not path.strip():
        raise CaseError(
            f"--set {assignment}: write it as key.path=value, for example --set mesh.degree=3"
        )
    section, location = _section_of_setting(source, assignment, path.strip().split("."))
    # the new value, checked as a source of its own
    setting = Source(f"--set {assignment}", {})
    setting_node = _parsed(setting, lambda: yaml.compose(text, Loader=_Loader))
    _note_places(setting_node or yaml.ScalarNode("", ""), (), setting)
    section[location[-1]] = _parsed(setting, lambda: yaml.load(text, Loader=_Loader))
    # a replaced key that the file has is removed. One that another setting gave stays, and is later
    # refused together with this key
    replaced_key = REPLACED_KEYS.get(location, "")
    place_of_replaced_key = source.places.get((*location[:-1], replaced_key), "--set")
    if not place_of_replaced_key.startswith("--set"):
        section.pop(replaced_key, None)
    # the place of the key, and of sections on the way that the setting has made
    for length in range(1, len(location) + 1):
        if length == len(location) or location[:length] not in source.places:
            source.places[location[:length]] = f"--set {assignment}"


def _section_of_setting(
    source: Source, assignment: str, keys: Sequence[str]
) -> tuple[Any, Location]:
    """Return the section or list that has the last of the keys of a setting, and their location.

    Sections that are missing on the way are made. In the location, positions in lists are numbers.

    Parameters
    ----------
    assignment
        The setting, for messages.

    Raises
    ------
    CaseError
        If a key on the way is neither a section nor an item of a list.
    """
    section: Any = source.data
    location: list[str | int] = []
    for i, key in enumerate(keys):
        if isinstance(section, list):
            if not key.isdecimal() or int(key) >= len(section):
                allowed = f"items 0 to {len(section) - 1}" if section else "no items"
                raise CaseError(
                    f"--set {assignment}: {'.'.join(keys[: i + 1])}: the list has {allowed}"
                )
        elif not isinstance(section, dict):
            raise CaseError(f"--set {assignment}: {keys[i - 1]} is a value, not a section")
        location.append(int(key) if isinstance(section, list) else key)
        # down to the section of the next key
        if i < len(keys) - 1:
            if isinstance(section, list):
                section = section[int(key)]
            else:
                section = section.setdefault(key, {})
    return section, tuple(location)


def dotted(location: Location) -> str:
    """Return a location as text, such as shell.defect.width."""
    return ".".join(str(key) for key in location)
