"""The JSON Schema of the case file, for editors; docs/case.schema.json is made by it."""

import json
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.meanings import meaning
from magshell_fenicsx.parts.registered import PARTS

_NOISE = {"title", "discriminator", "gt", "ge", "lt", "le"}  # the last are bounds of quantities, which are text


class _WithMeanings(GenerateJsonSchema):
    """Gives keys their docstrings."""

    def model_schema(self, schema: core_schema.ModelSchema) -> dict[str, Any]:
        found = super().model_schema(schema)
        for key, value in found.get("properties", {}).items():
            if words := meaning(schema["cls"], key):
                value.setdefault("description", words)
        return found

    def encode_default(self, dft: Any) -> Any:
        return super().encode_default(dft.model_dump(mode="json") if isinstance(dft, BaseModel) else dft)


def schema() -> dict[str, Any]:
    """What a case file may hold, key by key; rules between keys are `Case`'s alone."""
    head = {"$schema": GenerateJsonSchema.schema_dialect, "title": "magshell_fenicsx case"}
    whole = _without_noise(Case.model_json_schema(schema_generator=_WithMeanings))
    whole["properties"] = dict(
        sorted(whole["properties"].items(), key=lambda item: item[0] in PARTS)
    )  # parts come last
    return {**head, **whole}


def schema_text() -> str:
    return json.dumps(schema(), indent=1, ensure_ascii=False) + "\n"


def _without_noise(part: Any, *, names: bool = False) -> Any:
    """Without what pydantic adds and JSON Schema does not know; `names`: keys are those of the case, not its words."""
    if isinstance(part, list):
        return [_without_noise(item) for item in part]
    if not isinstance(part, dict):
        return part
    kept = part if names else {key: value for key, value in part.items() if key not in _NOISE}
    return {
        key: value if key == "default" else _without_noise(value, names=key in ("properties", "$defs"))
        for key, value in kept.items()
    }
