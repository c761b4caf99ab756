"""What programs give to the package: paths in place of cases, numbers with units, and mistakes."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_overloads, get_type_hints

import basix.ufl
import numpy as np
import pytest
from conftest import CASES
from dolfinx import fem, mesh
from mpi4py import MPI
from petsc4py import PETSc
from pydantic import BaseModel

import magshell_fenicsx as ms
from magshell_fenicsx.parts.foundation import Foundation
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.natural.section import NaturalSection
from magshell_fenicsx.parts.registered import FORMER_KINDS, STEPS
from magshell_fenicsx.problem.mesh_sizes import MeshSection
from magshell_fenicsx.problem.problem import Document
from magshell_fenicsx.python import SHAPES
from magshell_fenicsx.python_keys import (
    ContactKeys,
    DeadLoadKeys,
    EdgeKeys,
    FactorKeys,
    FactorKind,
    FieldKeys,
    FoundationKeys,
    GravityKeys,
    ImperfectionKeys,
    IndentationKeys,
    MeshKeys,
    NaturalKeys,
    NaturalStepKeys,
    PressureKeys,
    RotationKeys,
    SectionName,
    ShellKeys,
    SourceKeys,
    SpinKeys,
    TimeKeys,
)

FILE = CASES / "dimple_buckling.yaml"
UNITS = [
    "shell={geometry: hemisphere, radius: 25.2 mm, thickness: 0.28 mm, youngs_modulus: 1.8 MPa, "
    "poisson_ratio: 0.5, "
    "defect: {kind: dimple, amplitude: 1.64, width: 3.2}}"
]


@pytest.fixture(scope="module")
def plain() -> ms.Scene:
    return ms.Scene(ms.Case.load(FILE))


@pytest.fixture(scope="module")
def with_units() -> ms.Scene:
    return ms.Scene(ms.Case.load(FILE, UNITS))


def test_the_path_of_a_case(plain: ms.Scene) -> None:
    assert ms.Scene(str(FILE)).problem.document.data == plain.problem.document.data
    assert ms.run(FILE).knockdown == pytest.approx(0.32623, rel=1e-4)
    with pytest.raises(ms.CaseError, match=r"nowhere\.yaml: cannot be read"):
        ms.Scene("nowhere.yaml")
    with pytest.raises(
        ms.CaseError,
        match="give a problem, a Case, its mapping or the path of a case file, not a int",
    ):
        ms.run(1)  # type: ignore[arg-type]


def test_what_makes_a_problem(tmp_path: Path) -> None:
    """A case, its mapping and the problem itself; a problem has its energies, and is remade by a
    case alone.
    """
    case = ms.Case.load(FILE)
    problem = case.problem()
    assert ms.Scene(problem).problem is problem
    data = {**case.origin.data, "mesh": {"degree": 3}}
    assert ms.Scene(data).problem.mesh.degree == 3
    assert problem.with_values({"mesh.degree": 3}).document.data["mesh"]["degree"] == 3
    with pytest.raises(ms.CaseError, match="terms: a problem has its energies already"):
        ms.Scene(problem, terms=[ms.OwnTerm("springs", lambda r0, u: u.r[2])])
    with pytest.raises(ms.CaseError, match=r"mesh\.degree: needs the problem with another value"):
        replace(problem, remade=None).with_values({"mesh.degree": 3})
    with pytest.raises(ms.CaseError, match="give the problem a 'document'"):
        ms.run(replace(problem, document=Document()), tmp_path)


def test_names_of_earlier_versions(plain: ms.Scene) -> None:
    with pytest.warns(DeprecationWarning, match=r"Scene\.problem"):
        assert plain.plan is plain.problem
    with pytest.warns(DeprecationWarning, match=r"Scene\.problem"):
        assert plain.case.file_name == FILE.name
    with pytest.warns(DeprecationWarning, match=r"Scene\(problem\)"):
        assert ms.Scene(ms.Case.load(FILE), plan=plain.problem).problem is plain.problem


@pytest.mark.parametrize(
    ("target", "more", "column", "value"),
    [
        ("20 Pa", {}, "pressure_Pa", 20),
        ("-80 mm^3", {"control": "conjugate", "first": "5 Pa"}, "volume_change_mm3", -80),
        (0.05, {}, "p_over_pc", 0.05),
    ],
)
def test_targets_with_units(
    with_units: ms.Scene, target: float | str, more: dict[str, Any], column: str, value: float
) -> None:
    for targets in (target, [target]):
        records = list(ms.trace(with_units, "pressure", targets=targets, **more))
        assert ms.columns(with_units, records)[column][-1] == pytest.approx(value, rel=1e-6)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"targets": ["20 mT"]}, "targets: '20 mT': is not convertible to pascal"),
        ({"targets": ["many"]}, "targets: 'many': is not a number with a unit"),
        ({"targets": [None]}, "targets: None: must be a number, or text with a unit"),
        ({"targets": [0.1], "first": "1 mm"}, "first: '1 mm': is not convertible to pascal"),
    ],
)
def test_mistaken_targets(with_units: ms.Scene, more: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=f"trace: {said}"):
        next(ms.trace(with_units, "pressure", **more))


def test_units_that_the_case_has_not(plain: ms.Scene) -> None:
    with pytest.raises(
        ValueError, match=r"trace: targets: '20 Pa': has a unit: that needs youngs_modulus"
    ):
        next(ms.trace(plain, "pressure", targets=["20 Pa"]))
    own = ms.Scene(FILE, terms=[ms.OwnTerm("foundation", lambda r0, u: u.r[2] ** 2)])
    with pytest.raises(
        ValueError, match="trace: targets: '20 Pa': foundation has no unit here: give a number"
    ):
        next(ms.trace(own, "foundation", targets=["20 Pa"]))


def test_curves_of_nothing(plain: ms.Scene) -> None:
    records = list(ms.trace(plain, "pressure", targets=[0.1]))
    for none in ([], records[:1]):
        with pytest.raises(ValueError, match="curve: nothing has varied in these records"):
            ms.curve(plain, none)
    with pytest.raises(
        ValueError,
        match="curve: lambda: the scene has no such amplitude; these records vary pressure",
    ):
        ms.curve(plain, records, "lambda")
    assert ms.curve(plain, records).axes


def test_parts_are_classes() -> None:
    """`isinstance` tells what an object is, and the text of a part is the call that made it."""
    assert isinstance(ms.Case.load(FILE).problem(), ms.Problem)
    assert not isinstance(ms.Case.load(FILE), ms.Problem)
    force = ms.Force("tip", depth="1 mm")
    assert isinstance(force, ms.Force)
    assert isinstance(force, ms.Step)
    assert repr(ms.Clamped("rim")) == "Clamped('rim')"
    assert repr(force) == "Force('tip', depth='1 mm')"
    assert repr(ms.Field([0, 0, 1], [0, 0, 1], lambda_m=1e-3)) == (
        "Field([0, 0, 1], [0, 0, 1], lambda_m=0.001)"
    )


KEYS_OF_STEPS = {
    "pressure": PressureKeys,
    "indentation": IndentationKeys,
    **dict.fromkeys(set(get_args(FactorKind)) & {*STEPS}, FactorKeys),
    "imperfection": ImperfectionKeys,
    "rotation": RotationKeys,
    "natural": NaturalStepKeys,
    "dead": DeadLoadKeys,
    "edge": EdgeKeys,
    "contact": ContactKeys,
    "source": SourceKeys,
    "spin": SpinKeys,
    "gravity": GravityKeys,
    "time": TimeKeys,
}


@pytest.mark.parametrize("kind", STEPS)
def test_keys_of_steps_are_those_of_a_case(kind: str) -> None:
    """The keys that editors and mypy know are those that a case has."""
    keys, section = KEYS_OF_STEPS[kind], STEPS[kind]
    assert {*get_type_hints(keys)} == {*section.model_fields} - {"kind"}
    for name, annotation in get_type_hints(keys).items():
        if get_origin(annotation) is Literal:
            known = section.model_fields[name].annotation
            assert annotation in (known, *get_args(known))


def test_kinds_of_steps_are_those_of_a_case() -> None:
    """Each is a kind of one overload of `ms.Step`, also by its former name."""
    kinds = [
        kind
        for overload in get_overloads(ms.Step.__init__)
        for kind in get_args(get_type_hints(overload)["kind"])
    ]
    assert sorted(kinds) == sorted([*STEPS, *(former for former, _ in FORMER_KINDS)])


def test_keys_of_shells_are_those_of_a_case() -> None:
    """Of all geometries together."""
    arguments = {"geometry", "file", "unit", "radius"}
    of_case = {key for section in SHAPES.values() for key in section.model_fields}
    assert {*ShellKeys.__annotations__} == of_case - arguments


@pytest.mark.parametrize(
    ("keys", "section"),
    [(FoundationKeys, Foundation), (NaturalKeys, NaturalSection), (MeshKeys, MeshSection)],
)
def test_keys_of_sections_are_those_of_a_case(keys: type, section: type[BaseModel]) -> None:
    assert {*keys.__annotations__} == {*section.model_fields}
    assert {*get_args(SectionName)} < {*ms.Case.model_fields}
    assert ms.Section("sensors", tip={"position": [0, 0, 2]}).key == "sensors"


def test_keys_of_a_field_are_those_of_a_case() -> None:
    known_otherwise = {"remanent", "applied", "lambda_m"}
    assert {*FieldKeys.__annotations__} == {*MagneticSection.model_fields} - known_otherwise


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ms.Force("tip"), 'Force: tip: where does it end? give depth, such as "2 mm"'),
        (lambda: ms.Clamped(2), "2: is no name: name the tag in ms.Shell"),  # type: ignore[arg-type]
        (
            lambda: ms.Shell(
                "hemisphere",
                radius_to_thickness=90,
                poisson_ratio=0.5,
                thickness_factor=lambda x: 1 + x[0],
            ).section(),
            "shell.thickness_factor: is a function of Python: give a formula",
        ),
    ],
)
def test_messages_say_what_to_write(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ms.CaseError, match=re.escape(message)):
        make()


def surface_of_triangles() -> mesh.Mesh:
    flat = mesh.create_rectangle(MPI.COMM_SELF, [(0, 0), (1, 1)], (2, 2))
    element = basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
    cells = flat.geometry.dofmap.astype(np.int64)
    # by name: releases of dolfinx differ in the order
    return mesh.create_mesh(MPI.COMM_SELF, cells, x=flat.geometry.x, e=element)


def shell_of(surface: mesh.Mesh | None = None, **keys: Any) -> ms.Shell:
    if surface is None:
        surface = surface_of_triangles()
        surface.topology.create_connectivity(1, 2)
        keys = {"edges": {"rim": mesh.exterior_facet_indices(surface.topology)}, **keys}
    return ms.Shell(surface, **{"thickness": 0.02, **keys})


def problem_of(*parts: Any, **keys: Any) -> ms.Problem:
    shell = shell_of(poisson_ratio=0.3, **keys)
    return ms.Problem(shell, ms.Clamped("rim"), *(parts or [ms.Pressure()]))


def cell_tags(surface: mesh.Mesh) -> mesh.MeshTags:
    return mesh.meshtags(surface, 2, np.arange(2, dtype=np.int32), np.ones(2, dtype=np.int32))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: shell_of(mesh.create_unit_cube(MPI.COMM_SELF, 1, 1, 1)),
            "its cells are of the kind tetrahedron; a mid-surface has triangles",
        ),
        (
            lambda: shell_of(
                mesh.create_unit_square(MPI.COMM_SELF, 1, 1, mesh.CellType.quadrilateral)
            ),
            "its cells are of the kind quadrilateral; a mid-surface has triangles",
        ),
        (
            lambda: shell_of(edges=["rim"]),
            "shell.edges: ['rim']: give names with their values: edges={\"rim\": 2}",
        ),
        (lambda: shell_of(edges={"rim": 2}), "edges.rim: 2: is a value of tags: give facet_tags"),
        (
            lambda: shell_of(
                surface := surface_of_triangles(), edges={"rim": 1}, facet_tags=cell_tags(surface)
            ),
            "edges.rim: 1: is a value of tags: give facet_tags",
        ),
        (
            lambda: shell_of(
                surface := surface_of_triangles(), thickness=fem.Constant(surface, 0.02)
            ),
            "shell.thickness: is a length alone: give a number or text, and thickness_factor",
        ),
        (lambda: problem_of(thickness=-0.02), "shell.thickness: -0.02: must be greater than 0"),
        (
            lambda: problem_of(thickness_factor="1 + 0.2*r"),
            "shell.thickness_factor: '1 + 0.2*r': allowed are numbers, x, y, z, pi",
        ),
        (
            lambda: problem_of(thickness_factor=fem.Constant(surface_of_triangles(), 1.0)),
            "shell.thickness_factor: is a constant on another mesh than that of the shell",
        ),
        (
            lambda: problem_of([ms.Pressure()]),
            "[Pressure()]: allowed are what ms.Clamped, ms.Field, ms.Step, ... give",
        ),
        (
            lambda: problem_of(ms.Pressure(until="buckling")),  # type: ignore[arg-type]
            "loading.until: 'buckling': must be 'limit', 'bifurcation', 'target'",
        ),
        (
            lambda: problem_of(ms.OwnTerm("pressure", lambda r0, u: u.r[2] ** 2)),
            "something else has this name already: an amplitude or a column of the package; give "
            "another one, such as own_pressure",
        ),
        (
            lambda: ms.Problem(shell_of(), points=[[0, 0, 0]]),  # type: ignore[arg-type]
            'points: [[0, 0, 0]]: give names with their values: points={"tip": [1, 0, 0]}',
        ),
        (
            lambda: ms.Model(FILE, comm=2),  # type: ignore[arg-type]
            "comm: 2: give a communicator, such as MPI.COMM_WORLD of mpi4py",
        ),
        (
            lambda: ms.sweep(FILE, "a=1,2", executor=4),  # type: ignore[arg-type]
            "executor: 4: is no executor: give one of concurrent.futures",
        ),
    ],
)
def test_mistakes_in_problems(make: Callable[[], Any], message: str) -> None:
    with pytest.raises((ms.CaseError, ms.MeshError), match=re.escape(message)):
        make()


@pytest.mark.parametrize(
    ("use", "message"),
    [
        (lambda model: model.set(presure=1), "set: presure: the scene has no such amplitude, only"),
        (lambda model: model.set(pressure=[1]), "set: pressure: [1]: must be a number, or text"),
        (
            lambda model: model.put(np.zeros(3)),
            "put: a ndarray: give a state, a record, or a PETSc",
        ),
        (
            lambda model: model.put(PETSc.Vec().createSeq(5, comm=MPI.COMM_SELF)),
            "put: a vector of 5 unknowns on this rank, where the model has",
        ),
        (
            lambda model: model.function(np.zeros(7)),
            "function: a vector of 7 unknowns on this rank",
        ),
        (lambda model: model.modes(0), "modes: 0: give a number from 1 on"),
        (
            lambda model: next(ms.trace(model, "pressure", np.zeros(3))),
            "trace: start: a ndarray: give a record or a state",
        ),
        (
            lambda model: next(ms.trace(model, "pressure", control="laod")),
            "trace: control: 'laod': allowed are load, conjugate, arc",
        ),
        (
            lambda model: next(ms.trace(model, "pressure", until="limits")),
            "trace: until: 'limits': allowed are limit, bifurcation, target, points",
        ),
        (
            lambda model: next(ms.trace(model, "pressure", steps=0)),
            "trace: steps: 0: give a number from 1 on",
        ),
        (
            lambda model: ms.columns(
                model, list(ms.trace(ms.Model(FILE), "pressure", targets=0.1))
            ),
            "columns: a record is of another model: give record.scene in place of the model",
        ),
        (lambda model: ms.columns([], model), "columns: give the model first, then what follow"),
        (lambda model: ms.surface(model, model), "surface: give the model first, then what follow"),
    ],
)
def test_mistakes_with_a_model(plain: Any, use: Callable[[Any], Any], message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        use(plain)


def test_loads_are_changed_by_set_alone() -> None:
    model = ms.Model(FILE)
    with pytest.raises(TypeError, match="does not support item assignment"):
        model.amplitudes["pressure"] = 0.1  # type: ignore[index]
    with pytest.warns(UserWarning, match=r"solve: all loads are 0 \(pressure\): give"):
        record = model.solve()
    assert record.amplitudes == model.amplitudes == {"pressure": 0}


def test_units_of_a_field() -> None:
    """Components in mT are those in tesla; over magnitudes they have none."""

    def magnetic(*fields: Any, **keys: Any) -> Any:
        problem = problem_of(
            ms.Field(*fields, **keys), thickness="0.02 m", youngs_modulus="1 MPa", unit="m"
        )
        return problem.document.data["magnetic"]

    assert magnetic([0, 0, "90 mT"], ["5 mT", 0, 0]) == magnetic([0, 0, 0.09], [0.005, 0, 0])
    remanent = magnetic([0, "0.1*x", "90 mT"], [0, 0, 0.005])["remanent"]
    assert remanent["components"] == ["0", "0.1*x", "0.09"]
    with pytest.raises(ms.CaseError, match=r"'90 mT'\]: with lambda_m vectors are over their magn"):
        magnetic([0, 0, "90 mT"], [0, 0, 1], lambda_m=0.01)
