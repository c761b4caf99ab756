"""The JSON Schema of the case file, for editors, and its reference in Markdown.

They are docs/case.schema.json and docs/case.md.
"""

import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.messages import meaning
from magshell_fenicsx.parts.registered import PARTS
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import AMPLITUDES, IN_TIME, OF_EVERY_RUN, QUANTITIES

_NOISE = {
    "title",
    "discriminator",
    "gt",
    "ge",
    "lt",
    "le",
}  # the last are bounds of quantities, which are text
Schema = dict[str, Any]
WHOLE = "The whole case"
TAGS = ("geometry", "kind")
HEAD = """\
# The case file

Every section and key, made from [case.schema.json](case.schema.json) by `magshell schema --markdown`. A case is YAML;
an unknown key, a missing one or one out of bounds is refused with file and line. Rules between keys (which target
goes with which control, for instance) stand in the text; `magshell check CASE.yaml` tells them all.

An editor that knows the schema completes keys, explains them and marks mistakes while one types: see
[howto.md](howto.md#let-the-editor-help).

Any key can be given on the command line, `--set loading.points=40`, sections too: `--set "loading={kind: field}"`.

**Units.** Dimensionless unless a unit stands in the table. On hemispheres, discs and strips a length, Young's modulus
and a flux density are text with a unit: `25.2 mm`, `1.8 MPa`, `60 mT`. On all other geometries either all lengths and
Young's modulus have units, and points, a profile, loads and mesh.size may have (without they are in m, N, N/m, Pa; a
moment is per length, in N); or nothing has, and everything is in one's own units. A flux density has a unit everywhere.
In a case with units, whatever its geometry, a point, a body or a magnet whose numbers have no unit is in metres.
"""


COLUMNS_HEAD = """
## The columns of path.csv

One row for each accepted point. The numbers are dimensionless: multiply a number by its unit to get the quantity in SI.
A case with units has more columns at the end, which are in them already: those of "with units", `NAME_ux_mm` of
points, and `NAME_fx_N` and `NAME_mx_N_m` of supports. Terminal, pictures, report and sweeps then show these.
Named points add `NAME_ux`, `NAME_uy` and `NAME_uz`, in the unit of the shell's lengths. Where supports move, or with
`reactions: true`, every support adds its reaction on the shell: the forces `NAME_fx`, `NAME_fy` and `NAME_fz`, and the
moments `NAME_mx`, `NAME_my` and `NAME_mz` about the middle of the support's bounding box, where the support is now; in
N and N m if the case has units, else in its own (over E R² and E R³ if it has no lengths). A user-defined energy adds a
column with its name: its amplitude.
"""
AMPLITUDES_HEAD = """
The column `amplitude` names the amplitude that varied:
"""


class _WithMeanings(GenerateJsonSchema):
    """Gives keys their docstrings, and sections the full names of their classes as titles."""

    def model_schema(self, schema: core_schema.ModelSchema) -> dict[str, Any]:
        schema_of_model = super().model_schema(schema)
        schema_of_model["title"] = f"{schema['cls'].__module__}.{schema['cls'].__qualname__}"
        for key, value in schema_of_model.get("properties", {}).items():
            if words := meaning(schema["cls"], key):
                value.setdefault("description", words)
        return schema_of_model

    def encode_default(self, dft: Any) -> Any:
        return super().encode_default(
            dft.model_dump(mode="json") if isinstance(dft, BaseModel) else dft
        )


def schema() -> dict[str, Any]:
    """What a case file may hold, key by key; rules between keys are `Case`'s alone."""
    head = {"$schema": GenerateJsonSchema.schema_dialect, "title": "magshell_fenicsx case"}
    whole = _without_noise(_apart(Case.model_json_schema(schema_generator=_WithMeanings)))
    whole["properties"] = dict(
        sorted(whole["properties"].items(), key=lambda item: item[0] in PARTS)
    )  # parts come last
    whole["anyOf"] = [{"required": whole.pop("required")}, {"required": ["shells"]}]
    return {**head, **whole}


def schema_text() -> str:
    return json.dumps(schema(), indent=1, ensure_ascii=False) + "\n"


def _apart(whole: Schema) -> Schema:
    """With every section as a definition: pydantic 2.14 writes some in full where they stand."""
    titles = {
        f"#/$defs/{name}": section["title"]
        for name, section in whole["$defs"].items()
        if "title" in section
    }
    sections: dict[str, Schema] = {}

    def named(part: Any) -> Any:
        if isinstance(part, list):
            return [named(each) for each in part]
        if not isinstance(part, dict):
            return part
        inner = {
            key: value if key in ("default", "$defs") else named(value)
            for key, value in part.items()
        }
        if "$ref" in part:
            inner["$ref"] = titles.get(part["$ref"], part["$ref"])
        if "properties" not in part or part is whole or not isinstance(part.get("title"), str):
            return inner
        sections[part["title"]] = inner
        return {"$ref": part["title"]}

    with_names = named(whole)
    lifted = {name: named(section) for name, section in whole["$defs"].items()}
    others = {name: section for name, section in lifted.items() if f"#/$defs/{name}" not in titles}
    short = Counter(title.rsplit(".", 1)[-1] for title in sections)
    names = {
        title: last if short[last := title.rsplit(".", 1)[-1]] == 1 else title.replace(".", "__")
        for title in sections
    }

    def shortened(part: Any) -> Any:
        if isinstance(part, list):
            return [shortened(each) for each in part]
        if not isinstance(part, dict):
            return part
        return {
            key: f"#/$defs/{names[value]}" if key == "$ref" and value in names else shortened(value)
            for key, value in part.items()
        }

    definitions = {names[title]: section for title, section in sections.items()} | others
    return dict(shortened({**with_names, "$defs": dict(sorted(definitions.items()))}))


def _without_noise(part: Any, *, names: bool = False) -> Any:
    """Without what pydantic adds and JSON Schema does not know; `names`: keys are those of the
    case, not its words.
    """
    if isinstance(part, list):
        return [_without_noise(item) for item in part]
    if not isinstance(part, dict):
        return part
    kept = part if names else {key: value for key, value in part.items() if key not in _NOISE}
    return {
        key: value
        if key == "default"
        else _without_noise(value, names=key in ("properties", "$defs"))
        for key, value in kept.items()
    }


def reference() -> str:
    """The whole page."""
    whole = schema()
    sections = whole["$defs"]
    titles = {
        name: _title(paths, sections[name]) for name, paths in _places(whole, sections).items()
    }
    parts = [HEAD, _section(WHOLE, whole, titles)]
    parts += [_section(title, sections[name], titles) for name, title in titles.items()]
    return "\n".join([*parts, columns_page()])


def _places(whole: Schema, sections: dict[str, Schema]) -> dict[str, list[str]]:
    """Section -> the keys that it stands under, in the order of the file."""
    places: dict[str, list[str]] = {}

    def visit(part: Schema, path: str) -> None:
        named = {"NAME": part["additionalProperties"]} if part.get("additionalProperties") else {}
        for key, value in (part["properties"] | named).items():
            for name in _references(value):
                full_key = f"{path}{key}"
                if full_key not in places.setdefault(name, []):
                    places[name].append(full_key)
                    visit(sections[name], f"{full_key}.")

    visit(whole, "")
    return places


def _references(part: Any) -> Iterator[str]:
    """Names of the sections in a part of the schema."""
    for key, value in (
        part.items()
        if isinstance(part, dict)
        else enumerate(part if isinstance(part, list) else [])
    ):
        if key == "$ref":
            yield value.rsplit("/", 1)[-1]
        else:
            yield from _references(value)


def _title(paths: list[str], section: Schema) -> str:
    """The keys, and the values of what tells it from other sections under these."""
    for key in TAGS:
        if key in section.get("required", []):
            tag = section["properties"][key]
            return f"{paths[0]}, {key}: {', '.join(tag.get('enum', [tag.get('const')]))}"
    return ", ".join(paths)


def _section(title: str, section: Schema, titles: dict[str, str]) -> str:
    lines = ["", f"## {title}", "", section["description"], ""]
    if section["properties"]:
        lines += ["| key | allowed | unit | default | meaning |", "| --- | --- | --- | --- | --- |"]
        required = section.get("required", section.get("anyOf", [{}])[0].get("required", []))
        keys = sorted(
            section["properties"].items(), key=lambda item: item[0] not in TAGS
        )  # what tells it apart first
        lines += [_row(key, value, key in required, titles) for key, value in keys]
    else:
        lines += [f"Allowed: {_allowed(section, titles)}."]
    return "\n".join(lines) + "\n"


def _row(key: str, part: Schema, required: bool, titles: dict[str, str]) -> str:
    told = re.fullmatch(r"(.*?)(?: \[(.*)\])?", " ".join(part.get("description", "").split()))
    assert told
    value = part.get("default")
    default = (
        "**required**"
        if required
        else ""
        if isinstance(value, dict) or value is None
        else f"`{_plain(value)}`"
    )
    cells = (f"`{key}`", _allowed(part, titles), told[2] or "", default, told[1])
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def _allowed(part: Schema, titles: dict[str, str]) -> str:
    """What a value may be, in words."""
    if "$ref" in part:
        title = titles[part["$ref"].rsplit("/", 1)[-1]]
        return f"[{title.split(': ')[-1]}](#{anchor(title)})"
    for several in ("anyOf", "oneOf"):
        if several in part:
            words = [_allowed(one, titles) for one in part[several] if one.get("type") != "null"]
            return (", " if several == "oneOf" else " or ").join(words)
    if "const" in part or "enum" in part:
        return ", ".join(f"`{_plain(value)}`" for value in part.get("enum", [part.get("const")]))
    kind = part["type"]
    if kind == "string":
        return f"text such as `{part['examples'][0]}`" if "examples" in part else "text"
    if kind == "boolean":
        return "`true`, `false`"
    if kind == "array" and "prefixItems" in part:
        return f"[{', '.join(_allowed(one, titles) for one in part['prefixItems'])}]"
    if kind == "array":
        few, most = part.get("minItems"), part.get("maxItems")
        count = f"{few} × " if few == most and few else ""
        return f"list of {count}{_allowed(part['items'], titles)}"
    if kind == "object":
        return f"name: {_allowed(part['additionalProperties'], titles)}"
    return _bounded(part, {"number": "number", "integer": "whole number"}[kind])


def _bounded(part: Schema, kind: str) -> str:
    low = part.get("minimum", part.get("exclusiveMinimum"))
    above, most = ("from" if "minimum" in part else "above"), part.get("maximum")
    lower = "" if low is None else f", {above} {low:g}"
    upper = "" if most is None else f" to {most:g}" if low is not None else f", to {most:g}"
    return kind + lower + upper


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value)


def anchor(title: str) -> str:
    """Of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def columns_page() -> str:
    """Both tables in Markdown; the order of the parts' columns does not depend on what is imported
    first.
    """
    of_parts = [q for q in QUANTITIES.values() if q not in (*OF_EVERY_RUN, *IN_TIME)]
    columns = [
        (
            f"`{q.name}`",
            f"{q.html} {q.note}".strip() if q.symbol else q.words,
            q.unit,
            q.si,
            _in_units(q),
            q.meaning,
        )
        for q in (*OF_EVERY_RUN, *IN_TIME, *sorted(of_parts, key=lambda q: q.name))
    ]
    amplitudes = [
        (f"`{a.name}`", f"`{a.column}`", f"`{a.conjugate}`") for _, a in sorted(AMPLITUDES.items())
    ]
    return "\n".join(
        [
            COLUMNS_HEAD,
            *_table(("column", "label", "unit", "SI unit", "with units", "meaning"), columns),
            AMPLITUDES_HEAD,
            *_table(("amplitude", "column of its value", "displacement of its curve"), amplitudes),
            "",
        ]
    )


def _in_units(q: Quantity) -> str:
    return "" if q.kind == "text" else " or ".join(f"`{each.name}`" for each in q.in_units)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(cell.replace('|', '&#124;') for cell in line)} |" for line in lines]
