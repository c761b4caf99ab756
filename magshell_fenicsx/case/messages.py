"""What the user reads when a case is wrong: file, line, key, value, what is allowed."""

import difflib
import re
from typing import Any, get_args

from pydantic import BaseModel

from magshell_fenicsx.case.source import Location, Source, dotted


def explain(error: Any, source: Source, case: type[BaseModel]) -> str:
    """One line for one of pydantic's errors."""
    location = _without_tag(error["loc"], case)
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
        models = _models(case.model_fields[key].annotation)
        tag, tags = error["ctx"].get("tag"), [tag for m in models for tag in _tags(m)]
        said = "is missing" if tag is None else shown(tag)
        return f"{place}: {key}.{_tag_key(models)}: {said}; allowed: {', '.join(tags)}"
    if kind in ("model_type", "model_attributes_type"):
        return f"{place}: {key}: {shown(value)}: must be a section, with keys below it"
    if isinstance(value, dict | BaseModel):
        return f"{place}: {key}: {said}"
    return f"{place}: {key}: {shown(value)}: {said}"


def shown(value: Any) -> str:
    """The value as it was written, on one line of bearable length."""
    try:
        text = repr(value)
    except ValueError:  # Python prints no integers of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:77]}..."


def _without_tag(loc: Location, case: type[BaseModel]) -> Location:
    """Pydantic puts the `kind` of a section that has several after its name: take it out."""
    section = case.model_fields.get(str(loc[0])) if loc else None
    return (loc[0], *loc[2:]) if section and len(_models(section.annotation)) > 1 else loc


def _allowed_keys(location: Location, data: Any, case: type[BaseModel]) -> list[str]:
    """Keys of the section at a location."""
    model = case
    for key in location:
        data = data[key]
        if key in model.model_fields:  # else it is one of a list or mapping of sections
            models = _models(model.model_fields[str(key)].annotation)
            model = next((m for m in models if len(models) > 1 and data[_tag_key(models)] in _tags(m)), models[0])
    return list(model.model_fields)


def _models(annotation: Any) -> list[type[BaseModel]]:
    """Every section class within an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in get_args(annotation) for model in _models(part)]


def _tag_key(models: list[type[BaseModel]]) -> str:
    """The key that selects one of several section classes."""
    return next(key for key in ("kind", "geometry") if all(key in m.model_fields for m in models))


def _tags(model: type[BaseModel]) -> list[str]:
    """The values of that key that select a section class."""
    return [str(tag) for tag in get_args(model.model_fields[_tag_key([model])].annotation)]
