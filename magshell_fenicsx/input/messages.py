"""Messages about a wrong case: file, line, key, value, what is allowed; and meanings of keys.

Python does not keep the docstrings of keys: they are read in the source when somebody asks.

A section class is a pydantic model of a part of the case; a field is one of its keys. A location is
the sequence of keys and list positions that lead to a value. Where a value may be one of several
sections (a union), a key chooses: `kind` or `geometry`. Its values are tags. Pydantic puts tags
into the locations of its errors, after the key of the union. A mapping of sections has names of the
user as keys, such as a body's.
"""

import ast
import difflib
import inspect
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import cache
from typing import Any, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from magshell_fenicsx.input.source import CaseError, Location, Source, dotted

# Tags of unions without sections, which pydantic puts into locations.
NO_KEYS = ("a word", "a gas", "a pair", "a pair with keys")
NO_CONTAINER = ("list_type", "dict_type")  # errors about values that are no list or mapping
NAME_PATTERN_PART = "[A-Za-z]"  # in patterns of names; other patterns are of text with a unit


def meaning(section: type[BaseModel], key: str) -> str:
    """Return the docstring or description of a key of a section class; empty without.

    The docstring may stand in a base class of the section.
    """
    field = section.model_fields.get(key)
    if field is not None and field.description:
        return field.description
    docstrings = (_docstrings(base).get(key) for base in section.__mro__)
    return next((docstring for docstring in docstrings if docstring), "")


@cache
def _docstrings(section: type) -> dict[str, str]:
    """Return the docstrings of a section class's own keys, by key.

    A docstring is a text that stands alone below the annotated key in the source.
    """
    if not issubclass(section, BaseModel):
        return {}
    definition = _classes(section.__module__).get(section.__qualname__)
    if not definition:
        return {}
    docstrings = {}
    # each statement with the next one
    for key, statement in zip(definition.body, definition.body[1:], strict=False):
        if not isinstance(key, ast.AnnAssign) or not isinstance(key.target, ast.Name):
            continue
        value = statement.value if isinstance(statement, ast.Expr) else None
        text = value.value if isinstance(value, ast.Constant) else None
        if isinstance(text, str):
            docstrings[key.target.id] = inspect.cleandoc(text)
    return docstrings


@cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """Return the definitions of the classes at the top of a module's source, by name.

    Empty without a source.
    """
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError, KeyError):
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


class InvalidCase(CaseError):
    """Error that sections refuse a case; the message has one line for each mistake.

    Parameters
    ----------
    errors
        Errors of pydantic, as `ValidationError.errors()` returns them.
    source
        The text of the case with the lines of its keys.
    case
        Class of the case.
    in_words
        Replaces names in a message by those of the case file.
    """

    def __init__(
        self,
        errors: Sequence[Any],
        source: Source,
        case: type[BaseModel],
        in_words: Callable[[str], str] = str,
    ) -> None:
        super().__init__(in_words(explained(errors, source, case)))
        self._errors, self._source, self._case, self._in_words = errors, source, case, in_words

    def lines_of_kinds(self, *kinds: str) -> list[str]:
        """Return the lines of the message for pydantic's errors of some kinds, such as "missing".

        The result has one text, of one or several lines, or is empty.
        """
        errors = [error for error in self._errors if error["type"] in kinds]
        return [self._in_words(explained(errors, self._source, self._case))] if errors else []

    def __reduce__(self) -> tuple[type[CaseError], tuple[str]]:
        return CaseError, (str(self),)  # for other ranks the message is enough


def explained(errors: Sequence[Any], source: Source, case: type[BaseModel]) -> str:
    """Return one line for each mistake in a case.

    Pydantic tries all members of a union, and each of them gives an error. If there are errors
    within a list or a mapping, these are told. Otherwise the errors about the value itself are.

    Parameters
    ----------
    errors
        Errors of pydantic, as `ValidationError.errors()` returns them.
    source
        The text of the case with the lines of its keys.
    case
        Class of the case.
    """
    locations = [_without_tag(error["loc"], source.data, case) for error in errors]

    def is_explained(location: Location, kind: str) -> bool:
        """Return whether another error says more about the mistake at a location."""
        has_inner_error = any(
            len(other_location) > len(location) and other_location[: len(location)] == location
            for other_location in locations
        )
        if has_inner_error:
            return True
        return kind in NO_CONTAINER and locations.count(location) > 1

    # two members of a union may give one line
    lines = [
        explain(error, location, source, case)
        for location, error in zip(locations, errors, strict=True)
        if not is_explained(location, error["type"])
    ]
    return "\n".join(dict.fromkeys(lines))


def explain(error: Any, location: Location, source: Source, case: type[BaseModel]) -> str:
    """Return one line for an error of pydantic: place in the file, key, value, what is allowed.

    Parameters
    ----------
    error
        Error of pydantic.
    location
        Keys that lead to the value in the case.
    source
        The text of the case with the lines of its keys.
    case
        Class of the case.
    """
    # pydantic's words, in those of this program
    value, kind = error["input"], error["type"]
    problem = error["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    problem = re.sub(
        r"^\w+ should have (at \w+ \d+) items? after validation, not",
        r"must have \1 items, not",
        problem,
    )
    if kind == "string_pattern_mismatch":
        is_name = NAME_PATTERN_PART in error["ctx"]["pattern"]
        name_rule, number_rule = "a letter, then letters, digits and _", "a number with a unit"
        problem = f"must be {name_rule if is_name else number_rule}"
    # a message of a rule between sections begins with a key of its own, which it is about
    if own_key := re.match(r"(\w+(\.[^.:]+)+): ", problem):
        keys = own_key[1].split(".")
        location = tuple(int(key) if key.isdecimal() else key for key in keys)
        problem = problem[own_key.end() :]
    # the line by the kind of the error: first those that need no value, then those with the value
    place, key = source.place(location), dotted(location) or "case"
    if kind == "list_type":
        problem = "must be a list, in brackets"
    if kind == "dict_type":
        problem = f"must be a mapping, as {{{_example(value, location, source.data, case)}}}"
    if kind == "extra_forbidden":
        allowed = _allowed_keys(location[:-1], source.data, case)
        return f"{place}: {key}: {unknown(str(location[-1]), allowed)}"
    if kind == "missing":
        return f"{place}: {key}: is missing{_meaning(location, source.data, case)}"
    if kind.startswith("union_tag"):
        return f"{place}: {key}.{_tag_problem(error, location, source, case)}"
    if kind in ("model_type", "model_attributes_type"):
        return f"{place}: {key}: {shown_value(value)}: must be a section, with keys below it"
    if isinstance(value, dict | BaseModel):
        return f"{place}: {key}: {problem}"
    if problem.startswith(shown_value(value)):  # the value need not be told twice
        return f"{place}: {key}: {problem}"
    # own messages, and choices, need no meaning of the key
    says_all = kind in ("value_error", "literal_error")
    meaning = "" if says_all else _meaning(location, source.data, case)
    # the value; of a text that has become a number both, since limits are those of the number
    text_in_case = _data_at(source.data, location, str) if isinstance(value, float) else ""
    text = shown_value(value)
    if text_in_case:
        text = f"{shown_value(text_in_case)} is {value:.6g}"
    return f"{place}: {key}: {text}: {problem}{meaning}"


def _tag_problem(error: Any, location: Location, source: Source, case: type[BaseModel]) -> str:
    """Return a message about a wrong key that chooses a section, such as `kind`."""
    keys = location[:-1] if isinstance(location[-1], int) else location
    # the field with the union; in a list of sections, that of the list
    _, field_of_keys = _section_at(keys, source.data, case)
    field = field_of_keys or case.model_fields[str(location[0])]
    # the members of the union that a key chooses; the tag in the case, and those that are allowed
    sections = [m for m in _models(field.annotation) if _tag_key([m])]
    tag, tags = error["ctx"].get("tag"), dict.fromkeys(tag for m in sections for tag in _tags(m))
    problem = "is missing" if tag is None else shown_value(tag)
    return f"{_tag_key(sections)}: {problem}; allowed: {', '.join(tags)}"


def unknown(key: str, allowed: Collection[str], what: str = "key") -> str:
    """Return the message that there is no such key, with the nearest allowed one.

    `what` is the word for the key in the message.

    Examples
    --------
    >>> unknown("thicknes", ["radius", "thickness"])
    'unknown key; did you mean thickness? allowed here: radius, thickness'
    """
    nearest = difflib.get_close_matches(key, allowed, n=1)
    hint = f"did you mean {nearest[0]}? " if nearest else ""
    return f"unknown {what}; {hint}allowed here: {', '.join(sorted(allowed))}"


def refuse_unknown(
    keys: Iterable[str], section: type[BaseModel], place: str, others: Iterable[str] = ()
) -> None:
    """Refuse keys that are neither keys of a section class nor others that are allowed there.

    `place` is the key of the section, for the message.

    Raises
    ------
    CaseError
        With the first such key, and the nearest allowed one.
    """
    allowed = {*section.model_fields, *others}
    if unexpected := next((key for key in keys if key not in allowed), None):
        raise CaseError(f"{place}.{unexpected}: {unknown(unexpected, allowed)}")


def shown_value(value: Any) -> str:
    """Return a value as it was written, on one line of at most 80 characters."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no integers of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _without_tag(loc: Location, data: Any, case: type[BaseModel]) -> Location:
    """Return the location of an error in a case, without the tags that pydantic inserts.

    Pydantic puts the tag of a union's member after the key of the union. The walk along `loc` keeps
    the section classes that may be at the present place: several below the key of a union, one
    after its tag, none below a plain value.

    Parameters
    ----------
    loc
        Location of an error of pydantic.
    data
        Plain data of the case.
    case
        Class of the case.
    """
    # `is_name`: whether the next part of `loc` is a name that the user gives to a section
    sections, keys, is_name = [case], list[str | int](), False
    for key in loc:
        if key in NO_KEYS:
            continue
        # a word that neither the class nor the data has as a key is the tag of another union: one
        # of values, or of a section and a list of it
        fields = sections[0].model_fields if len(sections) == 1 else ()
        is_word = isinstance(key, str) and not is_name
        may_be_tag = is_word and len(sections) < 2
        if may_be_tag and key not in {*fields, *_data_at(data, keys, dict)}:
            continue
        # a name of the user, which may look like a tag or a key
        if is_name:
            keys.append(key)
            is_name = False
            continue
        # the tag of a union of sections: it leaves one class
        if len(sections) > 1 and not isinstance(key, int):
            sections = [m for m in sections if _tag_key([m]) and key in _tags(m)][:1] or sections
            continue
        # a key or a position in a list; the field of a key says what may be below it
        keys.append(key)
        if isinstance(key, str) and sections:
            field = sections[0].model_fields.get(key)
            sections = list(dict.fromkeys(_models(field.annotation))) if field else []
            is_name = _has_names(field)
    return tuple(keys)


def _data_at(data: Any, location: Sequence[str | int], kind: type) -> Any:
    """Return the part of plain data at a location; an empty `kind` if it is of another type."""
    for key in location:
        if isinstance(data, dict):
            data = data.get(key)
        elif isinstance(data, list) and isinstance(key, int):
            data = data[key] if key < len(data) else None
        else:
            data = None
    return data if isinstance(data, kind) else kind()


def _allowed_keys(location: Location, data: Any, case: type[BaseModel]) -> list[str]:
    """Return the keys of the section at a location in a case."""
    section, _ = _section_at(location, data, case)
    return list(section.model_fields)


def _meaning(location: Location, data: Any, case: type[BaseModel]) -> str:
    """Return the first words of a key's meaning and its unit, in brackets; empty without."""
    section, field = _section_at(location, data, case)
    description = meaning(section, str(location[-1])) if field else ""
    description = " ".join(description.split())  # of several lines of a docstring
    # without what has the key, as "Of kind: spring: "; the colon of a kind ends no words
    description = re.sub(r"^Of (\w+: [\w-]+[:,]|a \w+:) ", "", description)
    words, *_ = re.split(r"[;.,] | \[|(?<!kind)(?<!law)(?<!until)(?<!model): ", description)
    if not words:
        return ""
    unit = re.search(r"\[([^\[\]]+)\]$", description)
    return f" ({' '.join(words.split())}{f', in {unit[1]}' if unit else ''})"


def _example(value: Any, location: Location, data: Any, case: type[BaseModel]) -> str:
    """Return the begin of a mapping, such as "ball: ...", as an example in a message.

    `value` is what a case has in place of the mapping, such as a word or a list of words. If there
    is a name in it, the example begins with this as its key. If not, the first key comes from the
    type of the mapping's keys, or is "NAME".
    """
    _, field = _section_at(location, data, case)
    parts_of_annotation = _nested_annotations(field.annotation if field else None)
    mappings = (
        get_args(each_type) for each_type in parts_of_annotation if get_origin(each_type) is dict
    )
    key_type, value_type = next(mappings, (str, str))
    items = value if isinstance(value, list) else [value]
    names = [word for word in items if isinstance(word, str) and word.isidentifier()]
    first_key = (names or [*get_args(key_type), "NAME"])[0]
    values = (part for part in _nested_annotations(value_type) if isinstance(part, str))
    return f"{first_key}: {next(values, '...')}"


def _nested_annotations(annotation: Any) -> Iterator[Any]:
    """Iterate over a type annotation and all annotations within it."""
    yield annotation
    for part in get_args(annotation):
        yield from _nested_annotations(part)


def _section_at(
    location: Location, data: Any, case: type[BaseModel]
) -> tuple[type[BaseModel], FieldInfo | None]:
    """Return the section class at a location in a case, and the field of the location's last key.

    The field is None if the last key is no key of a section, but an index or a name of the user.

    Parameters
    ----------
    location
        Keys that lead to a value.
    data
        Plain data of the case, by which members of unions are chosen.
    case
        Class of the case.
    """
    # `section` is the class at the present place, `sections` are those that may be there by the
    # annotation; `is_name`: whether the next key is a user's name
    section, field, sections, is_name = case, None, list[type[BaseModel]](), False
    for key in location:
        # the data at the key
        if isinstance(data, dict):
            data = data.get(key)
        else:
            data = data[key] if isinstance(data, list) and isinstance(key, int) else None
        # the field is None if the key is a position in a list, a name of the user, or unknown;
        # positions and names keep the sections that the key before them has
        field = None if is_name else section.model_fields.get(str(key))
        is_name_or_position = is_name or isinstance(key, int)
        if field or not is_name_or_position:
            sections = _models(field.annotation) if field else []
        is_name = _has_names(field)
        # of several sections the one whose tag the data have, or else the first
        if sections and not is_name:
            tag = None
            if len(sections) > 1 and isinstance(data, dict):
                tag = data.get(_tag_key(sections))
            has_tag = (m for m in sections if tag is not None and tag in _tags(m))
            section = next(has_tag, sections[0])
    return section, field


def _has_names(field: FieldInfo | None) -> bool:
    """Return whether the keys below a field are names that the user gives to sections."""
    if field is None or get_origin(field.annotation) is not dict:
        return False
    return bool(_models(field.annotation))


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Return every section class within a type annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _tag_key(models: list[type[BaseModel]]) -> str:
    """Return the key, kind or geometry, that chooses one of section classes; empty without."""
    for key in ("kind", "geometry"):
        if all(key in m.model_fields for m in models):
            return key
    return ""


def _tags(model: type[BaseModel]) -> list[str]:
    """Return the values of the key that chooses a section class."""
    return [str(tag) for tag in get_args(model.model_fields[_tag_key([model])].annotation)]
