"""The JSON Schema of the case file, for editors; docs/case.schema.json is made by it."""

import json
from typing import Any

from pydantic.json_schema import GenerateJsonSchema

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.parts.registered import PARTS

_NOISE = {"title", "discriminator", "gt", "ge", "lt", "le"}  # the last are bounds of quantities, which are text


def schema() -> dict[str, Any]:
    """What a case file may hold, key by key; rules between keys are `Case`'s alone."""
    head = {"$schema": GenerateJsonSchema.schema_dialect, "title": "magshell_fenicsx case"}
    whole = _without_noise(Case.model_json_schema())
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
