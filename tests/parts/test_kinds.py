"""The kinds of bodies, imperfections, sources and laws: every file is in the list, and lengths are
found by their types.
"""

from importlib import import_module
from pkgutil import iter_modules
from typing import Annotated, Any, Literal, get_args

import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.input.section import Section, numbers_with_units, over_size
from magshell_fenicsx.parts.registry import REGISTERED, registered_classes
from magshell_fenicsx.quantities.quantity import PRESSURE
from magshell_fenicsx.shape.reference_shell import Coordinates

PARTS = "magshell_fenicsx.parts"


def kinds_of(module: str) -> set[str]:
    """The kinds of the sections that a module defines."""
    own = [
        each
        for each in vars(import_module(module)).values()
        if getattr(each, "__module__", "") == module
    ]
    key = "law" if module.startswith(f"{PARTS}.laws.") else "kind"
    fields = [
        each.model_fields.get(key)
        for each in own
        if isinstance(each, type) and issubclass(each, Section)
    ]
    return {kind for field in fields if field for kind in get_args(field.annotation)}


@pytest.mark.parametrize(
    ("role", "package"),
    [
        ("bodies", "bodies"),
        ("imperfections", "imperfections"),
        ("sources", "magnetism.sources"),
        ("laws", "laws"),
    ],
)
def test_every_file_with_a_kind_is_in_the_list(role: str, package: str) -> None:
    """But for steps, which are a list of their own."""
    (folder,) = import_module(f"{PARTS}.{package}").__path__
    names = [each.name for each in iter_modules([folder])]
    kinds = {name: name.replace("_", "-") if role == "laws" else name for name in names}
    files = {name for name in names if kinds[name] in kinds_of(f"{PARTS}.{package}.{name}")}
    registered = [path.removeprefix(f"{package}.").split(".")[0] for path in REGISTERED[role]]
    assert files == set(registered)
    key = "law" if role == "laws" else "kind"
    for section, file in zip(registered_classes(role), registered, strict=True):
        assert get_args(section.model_fields[key].annotation) == (kinds[file],)


CAP = {"geometry": "cap", "radius": 1.0, "thickness": 0.02, "poisson_ratio": 0.3}
DIMPLE = {"kind": "dimple", "amplitude": 1.0, "width": 3.0, "at": {"point": ["0 mm", 0.0, 1.0]}}


@pytest.mark.parametrize(
    ("key", "shell", "body"),
    [
        ("bodies.a.radius", {}, {"kind": "sphere", "radius": "2 mm"}),
        ("bodies.a.edge", {}, {"kind": "rod", "radius": 0.2, "edge": "1 mm"}),
        (
            "bodies.a.size.2",
            {},
            {"kind": "box", "size": [1, 1, "2 m"], "edge": 0.1, "axis": [1, 0, 0]},
        ),
        ("bodies.a.position.2", {}, {"kind": "plane", "position": [0, 0, "2 mm"]}),
        ("bodies.a.at.point.2", {}, {"kind": "plane", "at": {"point": [0, 0, "1 m"]}}),
        ("shell.imperfections.0.at.point.0", {"imperfections": [DIMPLE]}, None),
        ("shell.defect.at.point.0", {"defect": DIMPLE}, None),
    ],
)
def test_a_unit_beside_a_shell_without_one(
    key: str, shell: dict[str, Any], body: dict[str, Any] | None
) -> None:
    bodies = {"a": body} if body else {}
    with pytest.raises(ValueError, match=rf"{key}: has a unit, but the shell's lengths have none"):
        Case.model_validate(
            {"shell": CAP | shell, "boundary": {"rim": "clamped"}, "bodies": bodies}
        )


class Placed(Section):
    """As a step or a part of its own may be."""

    kind: Literal["placed"]
    through: list[Coordinates]
    name: str
    target: Annotated[float, over_size(PRESSURE)] | None = None


def test_numbers_with_units_are_found_by_what_is_made_of_them() -> None:
    """Every text that became a number, in any section; not names, and no targets over a size of the
    case.
    """
    data = {
        "kind": "placed",
        "through": [[0, "1 mm", 0], [1, 0, 0]],
        "name": "5 mm",
        "target": "1 Pa",
    }
    made = Placed.model_validate(data, context={"folder": ""})  # no shell: any number will do
    assert [*numbers_with_units(made, data, "loading.0")] == ["loading.0.through.0.1"]
    assert [*numbers_with_units({"a": [made]}, {"a": [data]}, "of")] == ["of.a.0.through.0.1"]
