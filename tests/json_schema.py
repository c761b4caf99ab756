"""JSON Schema as far as the schema of cases goes; a word that it does not know is an error, not passed over.

python3-jsonschema, which agrees on every case, is no part of the environment.
"""

import re
from collections.abc import Iterator
from typing import Any

TYPES = {"string": str, "number": (int, float), "integer": int, "boolean": bool, "array": list, "object": dict}
SILENT = {"$defs", "$schema", "title", "description", "default", "examples"}


def faults(value: Any, schema: dict[str, Any], whole: dict[str, Any], at: str = "case") -> Iterator[str]:
    """What of a value the schema does not allow."""
    for word, said in schema.items():
        if word == "$ref":
            yield from faults(value, whole["$defs"][said.removeprefix("#/$defs/")], whole, at)
        elif word in ("anyOf", "oneOf"):
            fitting = [one for one in said if not list(faults(value, one, whole, at))]
            if not fitting or (word == "oneOf" and len(fitting) > 1):
                yield f"{at}: fits {len(fitting)} of {word}"
        elif word == "type":
            yield from [] if _is(value, said) else [f"{at}: no {said}"]
        elif word not in SILENT:
            yield from _broken(word, said, value, schema, whole, at)


def _is(value: Any, name: str) -> bool:
    if name == "null":
        return value is None
    return isinstance(value, TYPES[name]) and (name == "boolean" or not isinstance(value, bool))


def _broken(word: str, said: Any, value: Any, schema: dict[str, Any], whole: dict[str, Any], at: str) -> Iterator[str]:
    number, several = _is(value, "number"), isinstance(value, list)
    if word == "properties":
        for key in said.keys() & (value if isinstance(value, dict) else {}):
            yield from faults(value[key], said[key], whole, f"{at}.{key}")
    elif word == "additionalProperties":
        for key in (value if isinstance(value, dict) else {}).keys() - schema.get("properties", {}):
            yield from [f"{at}: {key}"] if said is False else faults(value[key], said, whole, f"{at}.{key}")
    elif word == "items":
        for i, item in enumerate(value if several else []):
            yield from faults(item, said, whole, f"{at}.{i}")
    else:
        wrong = {
            "required": lambda: isinstance(value, dict) and bool(set(said) - value.keys()),
            "const": lambda: value != said,
            "enum": lambda: value not in said,
            "pattern": lambda: isinstance(value, str) and not re.search(said, value),
            "minimum": lambda: number and value < said,
            "maximum": lambda: number and value > said,
            "exclusiveMinimum": lambda: number and value <= said,
            "minItems": lambda: several and len(value) < said,
            "maxItems": lambda: several and len(value) > said,
        }
        if wrong[word]():
            yield f"{at}: {word} {said}"
