"""The JSON Schema of the case file, for editors, and its reference in Markdown.

The results are docs/case.schema.json and docs/case.md. A section of the case is a definition of the
schema; a part is any piece of the schema: a dictionary, a list or a value. A family is the sections
that may stand under one key of the case; the value of its tag, a key such as `kind`, tells which
one stands there. Many functions take `titles`, a mapping from the name of each section to its title
in the Markdown text, for links.
"""

import json
import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from pydantic import BaseModel
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core import core_schema

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.messages import meaning
from magshell_fenicsx.parts.registered import PART_CLASSES
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import AMPLITUDES, IN_TIME, OF_EVERY_RUN, QUANTITIES

# keys of pydantic that editors do not need; the last four are bounds of quantities, which are text
_NOISE = {"title", "discriminator", "gt", "ge", "lt", "le"}
Schema = dict[str, Any]
TITLE_OF_CASE = "The whole case"
TAG_KEYS = ("geometry", "kind")
REQUIRED = "required"
COMMON_KEYS = "keys of several kinds"
HEAD = """\
# The case file

Every section and key, made from [case.schema.json](case.schema.json) by `magshell schema
--markdown`. A case is YAML; an unknown key, a missing one or one out of bounds is refused with file
and line. Rules between keys (which target goes with which control, for instance) stand in the text;
`magshell check CASE.yaml` tells them all.

An editor that knows the schema completes keys, explains them and marks mistakes while one types:
see [howto.md](howto.md#let-the-editor-help).

Any key can be given on the command line, `--set loading.points=40`, sections too: `--set
"loading={kind: field}"`.

**Units.** Numbers are dimensionless unless a unit stands in the table. On hemispheres, discs and
strips a length, Young's modulus and a flux density are text with a unit: `25.2 mm`, `1.8 MPa`,
`60 mT`. On all other geometries give all lengths and Young's modulus units, or none. Without units,
use any consistent set. A flux density has a unit everywhere. In a case with units, whatever its
geometry, a number without one is in SI: points, bodies, magnets, a profile and mesh.size in m,
loads in N, N/m or Pa, a moment, which is per length, in N.
"""


COLUMNS_HEAD = """
## The columns of path.csv

One row for each accepted point. The numbers are dimensionless: multiply a number by its unit to get
the quantity in SI. A case with units has more columns at the end, which are in them already: those
of "with units", `NAME_ux_mm` of points, and `NAME_fx_N` and `NAME_mx_N_m` of supports. Terminal,
pictures, report and sweeps then show these. Named points add `NAME_ux`, `NAME_uy` and `NAME_uz`, in
the unit of the shell's lengths. Where supports move, or with `reactions: true`, every support adds
its reaction on the shell: the forces `NAME_fx`, `NAME_fy` and `NAME_fz`, and the moments `NAME_mx`,
`NAME_my` and `NAME_mz` about the middle of the support's bounding box, where the support is now; in
N and N m if the case has units, else in its own (over E R² and E R³ if it has no lengths). Every
body of `bodies` adds its forces of contact: `NAME_normal_force`, the integral of the contact
pressure whatever its direction, over 2πD/R (`NAME_normal_force_N` with units), of several shells
`NAME_SHELL_normal_force` too; the resultant on the body, `NAME_contact_fx`, `NAME_contact_fy` and
`NAME_contact_fz`, and its moment about the body's reference point (where its `position` is, at
present), `NAME_contact_mx`, `NAME_contact_my` and `NAME_contact_mz`, in the units of reactions. A
user-defined energy adds a column with its name: its amplitude.
"""
AMPLITUDES_HEAD = """
The column `amplitude` names the amplitude that varied:
"""


class _WithMeanings(GenerateJsonSchema):
    """Generator of a schema, with keys described by docstrings and sections titled by class."""

    def model_schema(self, schema: core_schema.ModelSchema) -> dict[str, Any]:
        """Return the schema of a section, titled by its class, with a description of each key."""
        schema_of_model = super().model_schema(schema)
        # module and class, so that titles are unique
        schema_of_model["title"] = f"{schema['cls'].__module__}.{schema['cls'].__qualname__}"
        for key, value in schema_of_model.get("properties", {}).items():
            if words := meaning(schema["cls"], key):
                value.setdefault("description", words)
        return schema_of_model

    def encode_default(self, dft: Any) -> Any:
        """Return a default as JSON data, also where the default is a whole section."""
        return super().encode_default(
            dft.model_dump(mode="json") if isinstance(dft, BaseModel) else dft
        )


def schema() -> dict[str, Any]:
    """Return the JSON Schema of a case file, key by key.

    Rules between several keys are checked by `Case` alone.
    """
    head = {"$schema": GenerateJsonSchema.schema_dialect, "title": "magshell_fenicsx case"}
    case_schema = _without_noise(
        _with_definitions(Case.model_json_schema(schema_generator=_WithMeanings))
    )
    # keys of `PART_CLASSES`, the sections that parts of the program register, come last
    properties = sorted(case_schema["properties"].items(), key=lambda item: item[0] in PART_CLASSES)
    case_schema["properties"] = dict(properties)
    # a case has one shell with its required keys, or several shells
    case_schema["anyOf"] = [{"required": case_schema.pop("required")}, {"required": ["shells"]}]
    return {**head, **case_schema}


def schema_text() -> str:
    """Return the content of docs/case.schema.json."""
    return json.dumps(schema(), indent=1, ensure_ascii=False) + "\n"


def _with_definitions(schema_of_case: Schema) -> Schema:
    """Return a schema with every section as a definition, and a reference wherever it is used.

    pydantic 2.14 writes some sections in full where they are used. References go by titles first,
    which are unique (module and class); then titles are shortened to names of classes.
    """
    # reference to a definition -> title of the section
    titles = {
        f"#/$defs/{name}": section["title"]
        for name, section in schema_of_case["$defs"].items()
        if "title" in section
    }
    sections: dict[str, Schema] = {}

    def referring(part: Any) -> Any:
        """Return a part of the schema with each section replaced by a reference to its title.

        The sections themselves are collected in `sections`.
        """
        if isinstance(part, list):
            return [referring(item) for item in part]
        if not isinstance(part, dict):
            return part
        rewritten_part = {
            key: value if key in ("default", "$defs") else referring(value)
            for key, value in part.items()
        }
        if "$ref" in part:
            rewritten_part["$ref"] = titles.get(part["$ref"], part["$ref"])
        # a section is what has keys and a title, except the case itself
        has_keys_and_title = "properties" in part and isinstance(part.get("title"), str)
        if part is schema_of_case or not has_keys_and_title:
            return rewritten_part
        sections[part["title"]] = rewritten_part
        return {"$ref": part["title"]}

    with_names = referring(schema_of_case)
    definitions_of_case = {
        name: referring(section) for name, section in schema_of_case["$defs"].items()
    }
    other_definitions = {
        name: section
        for name, section in definitions_of_case.items()
        if f"#/$defs/{name}" not in titles
    }
    definition_names = _definition_names(sections)
    definitions = {
        definition_names[title]: section for title, section in sections.items()
    } | other_definitions
    with_definitions = {**with_names, "$defs": dict(sorted(definitions.items()))}
    return dict(_with_short_references(with_definitions, definition_names))


def _definition_names(titles: Collection[str]) -> dict[str, str]:
    """Return title of a section, its module and class -> name of its definition.

    That is the name of the class; two classes of one name keep the whole title.
    """
    class_counts = Counter(title.rsplit(".", 1)[-1] for title in titles)
    definition_names = {}
    for title in titles:
        class_name = title.rsplit(".", 1)[-1]
        is_unique = class_counts[class_name] == 1
        definition_names[title] = class_name if is_unique else title.replace(".", "__")
    return definition_names


def _with_short_references(part: Any, definition_names: dict[str, str]) -> Any:
    """Return a part of the schema with references to definitions in place of titles.

    `definition_names` maps the title of a section to the name of its definition.
    """
    if isinstance(part, list):
        return [_with_short_references(item, definition_names) for item in part]
    if not isinstance(part, dict):
        return part
    return {
        key: f"#/$defs/{definition_names[value]}"
        if key == "$ref" and value in definition_names
        else _with_short_references(value, definition_names)
        for key, value in part.items()
    }


def _without_noise(part: Any, *, names: bool = False) -> Any:
    """Return a schema without keywords that pydantic adds and JSON Schema does not know.

    Parameters
    ----------
    part
        Any part of a schema: a dictionary, a list or a value.
    names
        Whether the keys of `part` are names from the case, such as "title", and so all are kept.
    """
    if isinstance(part, list):
        return [_without_noise(item) for item in part]
    if not isinstance(part, dict):
        return part
    content = part if names else {key: value for key, value in part.items() if key not in _NOISE}
    cleaned = {}
    for key, value in content.items():
        has_names = key in ("properties", "$defs")
        # a default is a value, not a schema
        cleaned[key] = value if key == "default" else _without_noise(value, names=has_names)
    return cleaned


@dataclass(frozen=True)
class KeyText:
    """Words on one key of a section, in Markdown.

    Attributes
    ----------
    allowed
        The values that it allows, and their unit.
    default
        The default as code, `REQUIRED` for a key that must be given, or empty.
    """

    key: str
    meaning: str
    allowed: str
    default: str

    def item(self, kinds: str = "") -> str:
        """Return the key as an item of a list in Markdown.

        `kinds` are words for the kinds of section that have the key; empty if all have it.
        """
        default = self.default and (
            self.default if self.default == REQUIRED else f"default {self.default}"
        )
        facts = "; ".join(filter(None, (self.allowed, default, kinds)))
        meaning = f"{self.meaning.removesuffix('.')}. " if self.meaning else ""
        return f"- `{self.key}`: {meaning}*{facts}*"


def reference() -> str:
    """Return the content of docs/case.md.

    Sections that a tag such as `kind` tells apart form a family. Their common keys are listed once,
    before the sections.
    """
    case_schema = schema()
    # name of a section -> its schema, the key paths at which it stands, and its title
    sections, places = case_schema["$defs"], _places(case_schema, case_schema["$defs"])
    titles = {name: _title(paths, sections[name]) for name, paths in places.items()}
    # key path of a family -> its sections
    families = defaultdict[str, list[Schema]](list)
    for name, title in titles.items():
        if _tag_key(sections[name]):
            families[_family(title)].append(sections[name])
    texts = [HEAD, _section(TITLE_OF_CASE, case_schema, titles)]
    # the common keys of a family are written before the first of its sections
    common_of_family = dict[str, set[KeyText]]()
    for name, title in titles.items():
        family = _family(title)
        if family in families and family not in common_of_family:
            # the list of common keys, empty if there are none, and what it says of each
            text, common_of_family[family] = _common_keys(family, families[family], titles)
            texts += [text] if text else []
        common = common_of_family[family] if _tag_key(sections[name]) else set()
        texts.append(_section(title, sections[name], titles, common))
    return "\n".join([*texts, columns_page()])


def _family(title: str) -> str:
    """Return the key path that all sections of a family share, from the title of one of them.

    For example "loading" from "loading, kind: field".
    """
    return title.split(", ")[0]


def _tag_key(section: Schema) -> str | None:
    """Return the key whose value tells a section from others in its family; None without one."""
    return next((key for key in TAG_KEYS if key in section.get("required", [])), None)


def _tags(section: Schema) -> list[str]:
    """Return the values of its tag, such as "field", by which a section is chosen."""
    tag = section["properties"][_tag_key(section)]
    return list(tag.get("enum", [tag.get("const")]))


def _common_keys(
    family: str, sections: Sequence[Schema], titles: dict[str, str]
) -> tuple[str, set[KeyText]]:
    """Return the Markdown list of the keys that several sections of a family share, and these keys.

    Keys that differ in their default alone are one item of the list.

    Parameters
    ----------
    family
        Key path of the family, for the heading.
    sections
        The schemas of its sections.
    titles
        Name of each section -> its title, for links.

    Returns
    -------
    The text, empty if no key is shared; and what the list says of each key.
    """
    # what is said of a key -> the kinds of section of which that is said
    kinds_of_text = defaultdict[KeyText, list[str]](list)
    # the same without the default -> the number of sections: a shared key may differ in it
    counts = Counter[KeyText]()
    for section in sections:
        for text in _key_texts(section, titles):
            kinds_of_text[text] += _tags(section)
            counts[replace(text, default="")] += 1
    items, common = list[str](), set[KeyText]()
    all_kinds = [kind for section in sections for kind in _tags(section)]
    # an item for each key that more than one section has
    for without_default in (text for text, count in counts.items() if count > 1):
        texts = [text for text in kinds_of_text if replace(text, default="") == without_default]
        # the default of most kinds comes first, alone; others have their kinds in brackets
        texts.sort(key=lambda text: -len(kinds_of_text[text]))
        default = "; ".join(
            text.default + (f" ({', '.join(kinds_of_text[text])})" if i else "")
            for i, text in enumerate(texts)
            if text.default
        )
        kinds = [kind for text in texts for kind in kinds_of_text[text]]
        items.append(
            replace(without_default, default=default).item(_kinds_in_words(kinds, all_kinds))
        )
        common.update(texts)
    if not items:
        return "", common
    head = f"\n## {family}: {COMMON_KEYS}\n\n`{_tag_key(sections[0])}` is required.\n"
    return "\n".join([head, *items, ""]), common


def _kinds_in_words(kinds: Sequence[str], all_kinds: Sequence[str]) -> str:
    """Return words for the kinds of section that have a key; empty if all have it.

    They are "of a, b", or "all but c" where this is shorter. `all_kinds` are those of the family.
    """
    kinds_without = [kind for kind in all_kinds if kind not in kinds]
    if not kinds_without:
        return ""
    if len(kinds_without) < len(kinds):
        return f"all but {', '.join(kinds_without)}"
    return f"of {', '.join(kinds)}"


def _places(of_case: Schema, sections: dict[str, Schema]) -> dict[str, list[str]]:
    """Return name of a section -> the key paths under which a case has it.

    They are in the order of the file. A key of any name is NAME in a path.

    Parameters
    ----------
    of_case
        Schema of the whole case.
    sections
        Name of each section -> its schema.
    """
    places: dict[str, list[str]] = {}

    def visit(part: Schema, path: str) -> None:
        """Add the sections below `part`, whose keys are after `path`, and go on into new ones."""
        any_name = (
            {"NAME": part["additionalProperties"]} if part.get("additionalProperties") else {}
        )
        for key, value in (part["properties"] | any_name).items():
            for name in _references(value):
                full_key = f"{path}{key}"
                # a path that is known is not followed again
                if full_key not in places.setdefault(name, []):
                    places[name].append(full_key)
                    visit(sections[name], f"{full_key}.")

    visit(of_case, "")
    return places


def _references(part: Any) -> Iterator[str]:
    """Yield the names of the sections in a part of the schema."""
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(part, dict):
        items = part.items()
    elif isinstance(part, list):
        items = enumerate(part)
    for key, value in items:
        if key == "$ref":
            yield value.rsplit("/", 1)[-1]
        else:
            yield from _references(value)


def _title(paths: list[str], section: Schema) -> str:
    """Return the title of a section: its key paths, or the first one with the values of its tag."""
    key = _tag_key(section)
    return f"{paths[0]}, {key}: {', '.join(_tags(section))}" if key else ", ".join(paths)


def _section(
    title: str, section: Schema, titles: dict[str, str], common: Collection[KeyText] = ()
) -> str:
    """Return the Markdown text of a section, with the keys that are not among the common ones.

    Parameters
    ----------
    title
        Heading of the section.
    section
        Schema of the section.
    titles
        Name of each section -> its title, for links.
    common
        Keys that the list of common keys of its family describes.
    """
    lines = ["", f"## {title}", "", section["description"], ""]
    if not section["properties"]:
        return "\n".join([*lines, f"Allowed: {_allowed(section, titles)}."]) + "\n"
    texts = _key_texts(section, titles)
    own_keys = [text.item() for text in texts if text not in common]
    shared_keys = ", ".join(f"`{text.key}`" for text in texts if text in common)
    if shared_keys:
        link = f"[{COMMON_KEYS}](#{anchor(f'{_family(title)}: {COMMON_KEYS}')})"
        own_keys += (
            ["", f"And {link}: {shared_keys}."] if own_keys else [f"It has {link}: {shared_keys}."]
        )
    lines += own_keys
    return "\n".join(lines) + "\n"


def _key_texts(section: Schema, titles: dict[str, str]) -> list[KeyText]:
    """Return the words on each key of a section.

    The tag is left out where the title already says all of it.
    """
    # the whole case has two alternatives, one shell or several; the first has the required keys
    required = section.get("required", section.get("anyOf", [{}])[0].get("required", []))
    return [
        _key_text(key, value, key in required, titles)
        for key, value in section["properties"].items()
        if key != _tag_key(section) or "description" in value
    ]


def _key_text(key: str, part: Schema, required: bool, titles: dict[str, str]) -> KeyText:
    """Return the words on one key.

    Parameters
    ----------
    part
        Schema of the key's value. Its description ends with the unit in brackets, if there is one.
    required
        Whether the key must be given.
    titles
        Name of each section -> its title, for links.
    """
    # group 1 is the meaning, group 2 the unit or None
    meaning_and_unit = re.fullmatch(
        r"(.*?)(?: \[(.*)\])?", " ".join(part.get("description", "").split())
    )
    assert meaning_and_unit
    value = part.get("default")
    default = ""
    if required:
        default = REQUIRED
    elif value is not None and not isinstance(value, dict):
        default = f"`{_value_text(value)}`"
    unit = f"; unit: {meaning_and_unit[2]}" if meaning_and_unit[2] else ""
    return KeyText(key, meaning_and_unit[1], f"{_allowed(part, titles)}{unit}", default)


def _line(cells: Sequence[str]) -> str:
    """Return a line of a table in Markdown."""
    return f"| {' | '.join(cell.replace('|', '&#124;') for cell in cells)} |"


def _allowed(part: Schema, titles: dict[str, str]) -> str:
    """Return words, in Markdown, for the values that a part of the schema allows.

    `titles` maps the name of each section to its title, for links.
    """
    # a section
    if "$ref" in part:
        title = titles[part["$ref"].rsplit("/", 1)[-1]]
        # a title with a tag is "loading, kind: field": the link says the tag's value alone
        words = title.split(": ")[-1] if ": " in title else title.split(", ")[0]
        return f"[{words}](#{anchor(title)})"
    # alternatives, of which null is not shown
    for alternatives in ("anyOf", "oneOf"):
        if alternatives in part:
            choices = [
                _allowed(alternative, titles)
                for alternative in part[alternatives]
                if alternative.get("type") != "null"
            ]
            # pydantic writes oneOf for sections that a tag tells apart
            return (", " if alternatives == "oneOf" else " or ").join(choices)
    # fixed values
    if "const" in part or "enum" in part:
        return ", ".join(
            f"`{_value_text(value)}`" for value in part.get("enum", [part.get("const")])
        )
    # any value of a type
    kind = part["type"]
    if kind == "string":
        return f"text such as `{part['examples'][0]}`" if "examples" in part else "text"
    if kind == "boolean":
        return "`true`, `false`"
    if kind == "array":
        return _allowed_list(part, titles)
    if kind == "object":
        return f"name: {_allowed(part['additionalProperties'], titles)}"
    return _bounded(part, {"number": "number", "integer": "whole number"}[kind])


def _allowed_list(part: Schema, titles: dict[str, str]) -> str:
    """Return words for a list, such as "[text, number]" or "list of 3 × number".

    `titles` maps the name of each section to its title, for links.
    """
    if "prefixItems" in part:
        items = (_allowed(item, titles) for item in part["prefixItems"])
        return f"[{', '.join(items)}]"
    min_items, max_items = part.get("minItems"), part.get("maxItems")
    count = f"{min_items} × " if min_items == max_items and min_items else ""
    return f"list of {count}{_allowed(part['items'], titles)}"


def _bounded(part: Schema, kind: str) -> str:
    """Return words for a number with its bounds, such as "number, from 0 to 1".

    `kind` is "number" or "whole number".
    """
    smallest = part.get("minimum", part.get("exclusiveMinimum"))
    lower_word, largest = ("from" if "minimum" in part else "above"), part.get("maximum")
    lower = "" if smallest is None else f", {lower_word} {smallest:g}"
    upper = ""
    if largest is not None:
        upper = f" to {largest:g}" if smallest is not None else f", to {largest:g}"
    return kind + lower + upper


def _value_text(value: Any) -> str:
    """Return a value as a case file would write it."""
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value)


def anchor(title: str) -> str:
    """Return the anchor that GitHub gives to a heading."""
    return re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")


def columns_page() -> str:
    """Return the tables of the columns of path.csv and of the amplitudes, in Markdown.

    Columns of parts are sorted by name, so that their order does not depend on imports.
    """
    # columns of every run and of motions keep the order in which they are written
    part_quantities = [q for q in QUANTITIES.values() if q not in (*OF_EVERY_RUN, *IN_TIME)]
    columns = [
        (
            f"`{q.name}`",
            f"{q.html} {q.note}".strip() if q.symbol else q.words,
            q.unit,
            q.si,
            _in_units(q),
            q.meaning,
        )
        for q in (*OF_EVERY_RUN, *IN_TIME, *sorted(part_quantities, key=lambda q: q.name))
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
    """Return the names of the columns that show a quantity in units, joined by "or"."""
    return "" if q.kind == "text" else " or ".join(f"`{in_unit.name}`" for in_unit in q.in_units)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Return the lines of a table in Markdown."""
    return [_line(cells) for cells in (head, ["---"] * len(head), *rows)]
