"""The schema of the case file, and the page that is made of it: current, complete, and of one mind
with `Case`.
"""

import json
from functools import cache
from typing import Any

import pytest
from conftest import CASES
from jsonschema import Draft202012Validator

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.reference import reference, schema, schema_text
from magshell_fenicsx.input.source import CaseError, override, read_source

DOCS = CASES.parent / "docs"
PLATE = "shell={geometry: plate, length: 1, width: 1, thickness: 0.01, poisson_ratio: 0.3}"
LENGTHS = "length: 1 m, width: 30 cm, thickness: 1e-2 m, youngs_modulus: 1.8 MPa"


def test_committed_schema_is_current() -> None:
    """Else: magshell schema > docs/case.schema.json.

    Pydantic's versions differ in how they write 0.0.
    """
    assert json.loads((DOCS / "case.schema.json").read_text(encoding="utf-8")) == json.loads(
        schema_text()
    )


def test_committed_page_is_current() -> None:
    """Else: magshell schema --markdown > docs/case.md."""
    assert (DOCS / "case.md").read_text(encoding="utf-8") == reference()


def test_every_key_is_described() -> None:
    """All but those with one value, which tell sections apart and are described with these."""
    whole = schema()
    sections = {"case": whole, **whole["$defs"]}
    keys = [
        (name, key, part)
        for name, section in sections.items()
        for key, part in section["properties"].items()
    ]
    assert len(keys) > 100
    assert [
        (name, key) for name, key, part in keys if not ("description" in part or "const" in part)
    ] == []
    assert [name for name, section in sections.items() if "description" not in section] == []


@pytest.fixture(scope="module")
def committed() -> Draft202012Validator:
    content = json.loads((DOCS / "case.schema.json").read_text(encoding="utf-8"))
    Draft202012Validator.check_schema(content)
    return Draft202012Validator(content)


@pytest.mark.parametrize("file", sorted(CASES.rglob("*.yaml")), ids=lambda file: file.stem)
def test_every_case_fits(committed: Draft202012Validator, file: Any) -> None:
    committed.validate(read_source(file).data)


@pytest.mark.parametrize(
    "setting",
    [
        (
            "shell={geometry: hemisphere, radius: 25.2 mm, thickness: 0.32mm, "
            "youngs_modulus: 1.8 MPa, poisson_ratio: 0.5}"
        ),
        "shell={geometry: disc, radius: 1.5e-2 * m, thickness: .2 mm, poisson_ratio: 0}",
        f"shell={{geometry: plate, {LENGTHS}, poisson_ratio: 0.3, thickness_factor: 1 + x}}",
        (
            "shell={geometry: mesh, file: a.msh, radius: 1 m, unit: mm, thickness: 2 µm, "
            "poisson_ratio: 0}"
        ),
        (
            "shell={geometry: mesh, file: a.msh, radius: 1, thickness: 0.01, poisson_ratio: 0, "
            "thickness_factor: {a: 2}}"
        ),
        (
            "shell={geometry: revolution, profile: {radius: 1 + z, heights: [0, 1]}, "
            "thickness: 0.01, poisson_ratio: 0}"
        ),
        "boundary={equator: clamped}",
        "boundary={rim: {held: [x, z]}, left: symmetry, top: simply supported}",
        "magnetic={lambda_m: 1, remanent: {kind: expression, components: [x, '0', z**2]}}",
        (
            "magnetic={remanent: {flux_density: 1 T}, applied: {flux_density: 5 T, "
            "gradient: [[1,0,0],[0,1,0],[0,0,-2]]}}"
        ),
        (
            "magnetic={lambda_m: 1, remanent: {kind: layers, "
            "layers: [{fraction: 0.5}, {fraction: 0.5, polar: 9}]}}"
        ),
        (
            "loading={kind: dead, loads: [{at: A, force: [1, 0, 0]}, {over: all, pressure: 2}], "
            "factor: 1}"
        ),
        "loading={kind: rotation, to: {polar: 90}}",
        "shell.defect=null",
    ],
)
def test_forms_of_a_value_that_fit(setting: str) -> None:
    assert fits(setting)


@pytest.mark.parametrize(
    "setting",
    [
        "shell.radius_to_thickness=5",
        "shell.radius=25.2",
        "shell.youngs_modulus=MPa",
        "shell.defect.widht=3",
        "shell={geometry: hemisphere}",
        "shell={geometry: sphere, poisson_ratio: 0}",
        PLATE.replace("width: 1", "width: -1"),
        PLATE.replace("plate", "cap"),
        "boundary.equator=glued",
        "boundary.equator={held: [w]}",
        "magnetic.remanent.components=[x, y]",
        "magnetic.energy=third",
        "loading.kind=poke",
        "loading.volume=3",
        "loading.points=2.5",
        "mesh.degree='4'",
        "nothing=1",
    ],
)
def test_mistakes_that_do_not_fit(setting: str) -> None:
    """`Case` refuses each too."""
    assert not fits(setting)
    with pytest.raises(CaseError):
        Case.load(CASES / "dimple_buckling.yaml", [setting])


@cache
def current() -> Draft202012Validator:
    return Draft202012Validator(schema())


def fits(setting: str) -> bool:
    source = read_source(CASES / "dimple_buckling.yaml")
    override(source, setting)
    return bool(current().is_valid(source.data))
