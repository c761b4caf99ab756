"""What the user reads when a case is wrong: file, line, key, value, what is allowed."""

import difflib
import re
from typing import Any, get_args

from pydantic import BaseModel

from magshell_fenicsx.case.source import Location, Source, dotted


def explain(error: Any, source: Source, case: type[BaseModel]) -> str:
    """One line for one of pydantic's errors."""
    location = _without_tags(error["loc"], source.data)
    value, kind = error["input"], error["type"]
    said = error["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    if about := re.match(r"([a-z_]+(\.[a-z_]+)+): ", said):  # a rule between sections names its own key
        location, said = tuple(about[1].split(".")), said[about.end() :]
    place, key = source.place(location), dotted(location) or "case"
    if kind == "extra_forbidden":
        allowed = _allowed_keys(location[:-1], source.data, case)
        near = difflib.get_close_matches(str(location[-1]), allowed, n=1)
        hint = f"did you mean {near[0]}? " if near else ""
        return f"{place}: {key}: unknown key; {hint}allowed here: {', '.join(sorted(allowed))}"
    if kind == "missing":
        return f"{place}: {key}: is missing"
    if kind.startswith("union_tag"):
        tags = [_tag(m) for m in _models(case.model_fields[key].annotation)]
        return f"{place}: {key}.kind: {error['ctx'].get('tag', 'is missing')}; allowed: {', '.join(tags)}"
    if kind == "model_type":
        return f"{place}: {key}: {value!r}: must be a section, with keys below it"
    if isinstance(value, dict | BaseModel):
        return f"{place}: {key}: {said}"
    return f"{place}: {key}: {value!r}: {said}"


def _without_tags(loc: tuple[str | int, ...], data: Any) -> Location:
    """Pydantic puts the tag of a union (`kind`) into the location: take it out."""
    location: list[str | int] = []
    for key in loc:
        if isinstance(data, dict) and data.get("kind") == key and key not in data:
            continue
        location.append(key)
        data = data.get(key) if isinstance(data, dict) else None
    return tuple(location)


def _allowed_keys(location: Location, data: Any, case: type[BaseModel]) -> list[str]:
    """Keys of the section at a location."""
    model = case
    for key in location:
        data = data[key]
        models = _models(model.model_fields[str(key)].annotation)
        of_kind = [m for m in models if "kind" in m.model_fields and data["kind"] == _tag(m)]
        model = (of_kind or models)[0]
    return list(model.model_fields)


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Every section class within an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _tag(model: type[BaseModel]) -> str:
    """The value of `kind` that selects a section class."""
    return str(get_args(model.model_fields["kind"].annotation)[0])
