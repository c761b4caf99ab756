"""What the user reads when a case is wrong: file, line, key, value, what is allowed; and what a key
means.

Python does not keep the docstrings of keys: they are read in the source when somebody asks.
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

NO_KEYS = (
    "a word",
    "a gas",
    "a pair",
    "a pair with keys",
)  # tags of a union that has no sections to choose from
NO_CONTAINER = ("list_type", "dict_type")
LIKE_A_NAME = "[A-Za-z]"  # what patterns of names contain, others are of text with a unit


def meaning(section: type[BaseModel], key: str) -> str:
    """The docstring of a key of a section or its base, or what stands in its place; empty without."""
    field = section.model_fields.get(key)
    if field is not None and field.description:
        return field.description
    return next(
        (docstring for base in section.__mro__ if (docstring := _docstrings(base).get(key))), ""
    )


@cache
def _docstrings(section: type) -> dict[str, str]:
    """Key -> docstring of a class's own keys."""
    own = (
        _classes(section.__module__).get(section.__qualname__)
        if issubclass(section, BaseModel)
        else None
    )
    pairs = zip(own.body, own.body[1:], strict=False) if own else ()
    return {
        key.target.id: inspect.cleandoc(text.value.value)
        for key, text in pairs
        if isinstance(key, ast.AnnAssign) and isinstance(key.target, ast.Name)
        if isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }


@cache
def _classes(module: str) -> dict[str, ast.ClassDef]:
    """Name -> class at the top of a module that has a source."""
    try:
        tree = ast.parse(inspect.getsource(sys.modules[module]))
    except (OSError, TypeError, KeyError):
        return {}
    return {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}


class InvalidCase(CaseError):
    """A case that its sections refuse: one line for each mistake.

    Parameters
    ----------
    in_words
        Puts the names of the case file into a message.
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

    def of(self, *kinds: str) -> list[str]:
        """The lines of pydantic's errors of some kinds."""
        errors = [error for error in self._errors if error["type"] in kinds]
        return [self._in_words(explained(errors, self._source, self._case))] if errors else []

    def __reduce__(self) -> tuple[type[CaseError], tuple[str]]:
        return CaseError, (str(self),)  # for other ranks the message is enough


def explained(errors: Sequence[Any], source: Source, case: type[BaseModel]) -> str:
    """One line for each mistake.

    Pydantic tries all members of a union, and each has an error: what is a list or a mapping counts
    as one, and what is neither as a value.
    """
    placed = [(_without_tag(error["loc"], source.data, case), error) for error in errors]
    places = [location for location, _ in placed]

    def beside(location: Location, kind: str) -> bool:
        within = any(
            len(other) > len(location) and other[: len(location)] == location for other in places
        )
        return within or (kind in NO_CONTAINER and places.count(location) > 1)

    told = [
        explain(error, location, source, case)
        for location, error in placed
        if not beside(location, error["type"])
    ]
    return "\n".join(dict.fromkeys(told))


def explain(error: Any, location: Location, source: Source, case: type[BaseModel]) -> str:
    """One line for one of pydantic's errors, at the location of its key."""
    value, kind = error["input"], error["type"]
    said = error["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    said = re.sub(
        r"^\w+ should have (at \w+ \d+) items? after validation, not",
        r"must have \1 items, not",
        said,
    )
    if kind == "string_pattern_mismatch":
        name = LIKE_A_NAME in error["ctx"]["pattern"]
        said = (
            "must be a letter, then letters, digits and _"
            if name
            else "must be a number with a unit"
        )
    if about := re.match(r"(\w+(\.[^.:]+)+): ", said):  # a rule between sections names its own key
        keys = about[1].split(".")
        location, said = (
            tuple(int(key) if key.isdecimal() else key for key in keys),
            said[about.end() :],
        )
    place, key = source.place(location), dotted(location) or "case"
    if kind == "list_type":
        said = "must be a list, in brackets"
    if kind == "dict_type":
        said = f"must be a mapping, as {{{_example(value, location, source.data, case)}}}"
    if kind == "extra_forbidden":
        return f"{place}: {key}: {unknown(str(location[-1]), _allowed_keys(location[:-1], source.data, case))}"
    if kind == "missing":
        return f"{place}: {key}: is missing{_meaning(location, source.data, case)}"
    if kind.startswith("union_tag"):
        keys = location[:-1] if isinstance(location[-1], int) else location
        field = _found(keys, source.data, case)[1] or case.model_fields[str(location[0])]
        models = [m for m in _models(field.annotation) if _tag_key([m])]
        tag, tags = error["ctx"].get("tag"), dict.fromkeys(tag for m in models for tag in _tags(m))
        said = "is missing" if tag is None else shown(tag)
        return f"{place}: {key}.{_tag_key(models)}: {said}; allowed: {', '.join(tags)}"
    if kind in ("model_type", "model_attributes_type"):
        return f"{place}: {key}: {shown(value)}: must be a section, with keys below it"
    if isinstance(value, dict | BaseModel):
        return f"{place}: {key}: {said}"
    if said.startswith(shown(value)):
        return f"{place}: {key}: {said}"
    says_all = kind in ("value_error", "literal_error")
    meaning = "" if says_all else _meaning(location, source.data, case)
    written = _at(source.data, location, str) if isinstance(value, float) else ""
    text = (
        f"{shown(written)} is {value:.6g}" if written else shown(value)
    )  # its limits are those of the number
    return f"{place}: {key}: {text}: {said}{meaning}"


def unknown(key: str, allowed: Collection[str], what: str = "key") -> str:
    """That there is no such key, and which is nearest to it.

    Examples
    --------
    >>> unknown("thicknes", ["radius", "thickness"])
    'unknown key; did you mean thickness? allowed here: radius, thickness'
    """
    near = difflib.get_close_matches(key, allowed, n=1)
    hint = f"did you mean {near[0]}? " if near else ""
    return f"unknown {what}; {hint}allowed here: {', '.join(sorted(allowed))}"


def refuse_unknown(
    keys: Iterable[str], section: type[BaseModel], place: str, others: Iterable[str] = ()
) -> None:
    """See that keys are those of a section, or others that stand there too.

    Raises
    ------
    CaseError
        With the first that is not, and the nearest one that is.
    """
    allowed = {*section.model_fields, *others}
    if strange := next((key for key in keys if key not in allowed), None):
        raise CaseError(f"{place}.{strange}: {unknown(strange, allowed)}")


def shown(value: Any) -> str:
    """The value as it was written, on one line of bearable length."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no integers of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _without_tag(loc: Location, data: Any, case: type[BaseModel]) -> Location:
    """Pydantic puts what distinguishes the members of a union after their key: take it out."""
    models, kept, named = [case], list[str | int](), False
    for key in loc:
        if key in NO_KEYS:
            continue
        known = models[0].model_fields if len(models) == 1 else ()
        if (
            len(models) < 2
            and not named
            and isinstance(key, str)
            and key not in {*known, *_at(data, kept, dict)}
        ):
            continue  # of a union of values, or of a section and a list of it
        if named:
            kept.append(key)
            named = False
            continue
        if len(models) > 1 and not isinstance(key, int):
            models = [m for m in models if _tag_key([m]) and key in _tags(m)][:1] or models
            continue
        kept.append(key)
        if isinstance(key, str) and models:
            field = models[0].model_fields.get(key)
            models = list(dict.fromkeys(_models(field.annotation))) if field else []
            named = _has_names(field)
    return tuple(kept)


def _at(data: Any, location: Sequence[str | int], kind: type) -> Any:
    """The part of plain data at a location; an empty one if it is of another kind."""
    for key in location:
        fits = isinstance(data, dict) or (
            isinstance(data, list) and isinstance(key, int) and key < len(data)
        )
        data = data.get(key) if isinstance(data, dict) else data[key] if fits else None
    return data if isinstance(data, kind) else kind()


def _allowed_keys(location: Location, data: Any, case: type[BaseModel]) -> list[str]:
    """Keys of the section at a location."""
    return list(_found(location, data, case)[0].model_fields)


def _meaning(location: Location, data: Any, case: type[BaseModel]) -> str:
    """The first words on a key, in brackets, with its unit."""
    section, field = _found(location, data, case)
    description = meaning(section, str(location[-1])) if field else ""
    words, unit = (
        re.split(r"[;:.,] | \[", description)[0],
        re.search(r"\[([^\[\]]+)\]$", description),
    )
    return f" ({' '.join(words.split())}{f', in {unit[1]}' if unit else ''})" if words else ""


def _example(value: Any, location: Location, data: Any, case: type[BaseModel]) -> str:
    """How a mapping begins that was written as a word or a list of words."""
    field = _found(location, data, case)[1]
    parts = _parts(field.annotation if field else None)
    keys, of = next((get_args(part) for part in parts if get_origin(part) is dict), (str, str))
    words = value if isinstance(value, list) else [value]
    named = [word for word in words if isinstance(word, str) and word.isidentifier()]
    first = named or [*get_args(keys), "NAME"]
    what = next((part for part in _parts(of) if isinstance(part, str)), "...")
    return f"{first[0]}: {what}"


def _parts(annotation: Any) -> Iterator[Any]:
    """An annotation and all within it."""
    yield annotation
    for part in get_args(annotation):
        yield from _parts(part)


def _found(
    location: Location, data: Any, case: type[BaseModel]
) -> tuple[type[BaseModel], FieldInfo | None]:
    """The innermost section at a location; and the last key, if it is one of a section."""
    model, field, models, named = case, None, list[type[BaseModel]](), False
    for key in location:
        if isinstance(data, dict):
            data = data.get(key)
        else:
            data = data[key] if isinstance(data, list) and isinstance(key, int) else None
        # None: of a list or mapping of sections, or a part of a union
        field = None if named else model.model_fields.get(str(key))
        if field or not (named or isinstance(key, int)):
            models = _models(field.annotation) if field else []
        named = _has_names(field)
        if models and not named:
            tag = data.get(_tag_key(models)) if len(models) > 1 and isinstance(data, dict) else None
            model = next((m for m in models if tag is not None and tag in _tags(m)), models[0])
    return model, field


def _has_names(field: FieldInfo | None) -> bool:
    """Whether the keys below a key are names that the user gives to sections."""
    return (
        field is not None
        and get_origin(field.annotation) is dict
        and bool(_models(field.annotation))
    )


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Every section class within an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _tag_key(models: list[type[BaseModel]]) -> str:
    """The key that selects one of several section classes; empty without one."""
    return next(
        (key for key in ("kind", "geometry") if all(key in m.model_fields for m in models)), ""
    )


def _tags(model: type[BaseModel]) -> list[str]:
    """The values of that key that select a section class."""
    return [str(tag) for tag in get_args(model.model_fields[_tag_key([model])].annotation)]
