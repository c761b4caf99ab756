"""Problems without a case file, on meshes of dolfinx: the numbers of a case, fields as functions,
displacements as one.

A function that a formula equals gives the numbers of the formula, a mesh those of the same mesh in
a file.
"""

import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import basix.ufl
import gmsh
import numpy as np
import pytest
import ufl
from command import mpirun
from conftest import CASES
from dolfinx import fem, mesh
from mpi4py import MPI

import magshell_fenicsx as ms
from magshell_fenicsx.mesh.patch import MeshError

try:
    from dolfinx.io import gmsh as gmshio
except ImportError:  # dolfinx 0.9
    from dolfinx.io import gmshio

R = 25.0
MATERIAL = {"thickness": "2 mm", "youngs_modulus": "1 MPa", "poisson_ratio": 0.4, "unit": "mm"}
HOWTO = CASES.parent / "docs/howto.md"


@pytest.fixture(scope="module")
def dome(tmp_path_factory: pytest.TempPathFactory) -> tuple[mesh.Mesh, mesh.MeshTags, Path]:
    """A coarse hemisphere of quadratic triangles, in mm, with the tag 2 of its rim; and the same as
    a file.
    """
    file = tmp_path_factory.mktemp("dome") / "dome.msh"
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.model.occ.addSphere(0, 0, 0, R, angle1=0)
    gmsh.model.occ.remove(
        [(3, 1), (2, 2)]
    )  # left is the surface 1; dolfinx 0.11 wants all of a mesh tagged
    gmsh.model.occ.synchronize()
    rim = gmsh.model.getEntitiesInBoundingBox(-26, -26, -0.1, 26, 26, 0.1, dim=1)
    gmsh.model.addPhysicalGroup(2, [1], 1, name="all")
    gmsh.model.addPhysicalGroup(1, [tag for _, tag in rim], 2, name="rim")
    gmsh.option.setNumber("Mesh.MeshSizeMax", 0.7 * R)
    gmsh.model.mesh.generate(2)
    gmsh.model.mesh.setOrder(2)
    gmsh.write(str(file))
    domain, _, facet_tags, *_ = gmshio.model_to_mesh(gmsh.model, MPI.COMM_SELF, 0, gdim=3)
    gmsh.finalize()
    return domain, facet_tags, file


Dome = tuple[mesh.Mesh, mesh.MeshTags, Path]
PRESSED = ms.Pressure(control="load", until="target", pressure=0.2, points=1)


def shell(dome: Dome, **keys: Any) -> ms.Shell:
    domain, facet_tags, _ = dome
    return ms.Shell(domain, edges={"rim": 2}, facet_tags=facet_tags, **MATERIAL, **keys)


def path(dome: Dome, *parts: Any, **keys: Any) -> list[dict[str, float]]:
    """What is observed along a pressure that grows."""
    scene = ms.Scene(
        ms.Problem(shell(dome, **keys), ms.Clamped("rim"), *parts, PRESSED), MPI.COMM_SELF
    )
    return [scene.observe(record.point.state) for record in ms.follow(scene)]


def close(
    found: list[dict[str, float]],
    wanted: list[dict[str, float]],
    *,
    but: str = "",
    rel: float = 1e-9,
) -> None:
    assert len(found) == len(wanted)
    for one, other in zip(found, wanted, strict=True):
        assert {k: v for k, v in one.items() if k != but} == pytest.approx(
            {k: v for k, v in other.items() if k != but}, rel=rel, abs=1e-14, nan_ok=True
        )


def function(dome: Dome, space: tuple[Any, ...], of: Any) -> fem.Function:
    found = fem.Function(fem.functionspace(dome[0], space))
    found.interpolate(of)
    return found


@pytest.mark.telling
def test_numbers_of_the_case_on_the_same_mesh(dome: Dome) -> None:
    case = {
        "shell": {"geometry": "mesh", "file": str(dome[2]), "radius": "25 mm", **MATERIAL},
        "boundary": {"rim": "clamped"},
        "symmetry": "none",
        "loading": {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 0.2,
            "points": 1,
        },
    }
    scene = ms.Scene(case, MPI.COMM_SELF)
    close(path(dome), [scene.observe(record.point.state) for record in ms.follow(scene)])


def test_a_shape_in_place_of_a_mesh() -> None:
    of_case = ms.Scene(CASES / "dimple_buckling.yaml")
    hemisphere = ms.Case.load(CASES / "dimple_buckling.yaml").shell
    keys = {
        key: value
        for key, value in hemisphere.model_dump(exclude_unset=True).items()
        if key != "geometry"
    }
    problem = ms.Problem(
        ms.Shell("hemisphere", **keys), ms.Clamped("equator"), ms.Pressure(until="limit")
    )
    *_, fold = ms.follow(problem)
    *_, wanted = ms.follow(of_case)
    assert problem.axisymmetric
    assert fold.point.state.mu["pressure"] == pytest.approx(
        wanted.point.state.mu["pressure"], rel=1e-9
    )


def test_thickness_as_a_function(dome: Dome) -> None:
    quadratic = function(dome, ("Lagrange", 2), lambda x: 1 + 0.2 * x[0] / R + 0.1 * x[1] / R)
    close(path(dome, thickness_factor=quadratic), path(dome, thickness_factor="1 + 0.2*x + 0.1*y"))
    close(
        path(dome, thickness_factor=function(dome, ("DG", 0), lambda x: 1 + 0 * x[0])), path(dome)
    )


def test_a_thickness_that_is_negative_between_the_nodes_of_the_displacement(dome: Dome) -> None:
    """Quadratic in each triangle: one at its vertices, below zero at the middle of a side."""
    thin = function(dome, ("DG", 2), lambda x: 1 + 0 * x[0])
    thin.x.array[3::6] = -0.02
    with pytest.raises(
        MeshError, match=r"shell\.thickness_factor: is not within 0\.001 to 1000 at"
    ):
        ms.Scene(
            ms.Problem(shell(dome, thickness_factor=thin), ms.Clamped("rim"), degree=3),
            MPI.COMM_SELF,
        )


def test_remanence_as_a_function(dome: Dome) -> None:
    remanent = function(
        dome, ("DG", 2, (3,)), lambda x: 0.06 * np.stack([x[1] / R, 0 * x[0], 1 + x[0] / R])
    )
    formulas = ["0.06*y", "0", "0.06*(1 + x)"]
    found, wanted = (path(dome, ms.Field(Br, [0, 0, -0.02])) for Br in (remanent, formulas))
    close(
        found, wanted, but="lambda_m", rel=1e-8
    )  # lambda_m counts from another size of the remanence


@pytest.mark.slow
def test_natural_curvature_as_a_function(dome: Dome) -> None:
    bent = function(dome, ("Lagrange", 2), lambda x: 3 * (1 + x[0] / R))
    formula = f"3*(1 + x/{R * 1e-3})"
    close(*(path(dome, ms.Section("natural", curvature=k)) for k in (bent, formula)))
    along = function(
        dome, ("Lagrange", 1, (3,)), lambda x: np.stack([3 + 0 * x[0], 1 + 0 * x[0], 0 * x[0]])
    )
    close(
        *(
            path(dome, ms.Section("natural", curvature=k, along=[1, 0, 0]))
            for k in (along, [3.0, 1.0, 0.0])
        )
    )


@pytest.mark.slow
def test_own_energies_with_functions(dome: Dome) -> None:
    def bed(r0: Any, u: Any, k: Any) -> Any:
        return k * ufl.dot(u.r, u.r) / 2

    def same_bed(r0: Any, u: Any) -> Any:
        return bed(r0, u, 1 + 0.3 * r0.r[0])

    def shove(r0: Any, u: Any, f: Any) -> Any:
        return ufl.dot(u.r, f)

    def same_shove(r0: Any, u: Any) -> Any:
        return ufl.dot(u.r, ufl.as_vector([0, r0.r[0], 1 + r0.r[1]]))

    k = function(dome, ("Lagrange", 2), lambda x: 1 + 0.3 * x[0] / R)
    found = path(dome, ms.OwnTerm("bed", bed, (k,), value=0.01, observed={"held": bed}))
    close(found, path(dome, ms.OwnTerm("bed", same_bed, value=0.01, observed={"held": same_bed})))
    assert found[-1]["held"] > 0
    f = function(
        dome, ("Lagrange", 2, (3,)), lambda x: np.stack([0 * x[0], x[0] / R, 1 + x[1] / R])
    )
    close(
        *(path(dome, ms.OwnTerm("shove", *of, value=1e-4)) for of in ((shove, (f,)), (same_shove,)))
    )
    nonlinear = function(
        dome, ("Lagrange", 5), lambda x: np.exp(x[0] / R)
    )  # above the degree of the displacement
    assert ms.OwnTerm("bed", bed, (nonlinear,)).digest


def _bed(r0: Any, u: Any, k: Any) -> Any:
    """Energy of springs of the stiffness k."""
    return k * ufl.dot(u.r, u.r) / 2


# what a function of the program stands for: name -> parts and keys of the problem
USES_OF_FUNCTIONS: Mapping[str, Callable[[Any], tuple[list[Any], dict[str, Any]]]] = {
    "thickness": lambda f: ([], {"thickness_factor": f}),
    "remanence": lambda f: ([ms.Field(f, [0, 0, -0.02])], {}),
    "stretch": lambda f: ([ms.Section("natural", stretch=f)], {}),
    "curvature": lambda f: ([ms.Section("natural", curvature=f)], {}),
    "own energy": lambda f: ([ms.OwnTerm("bed", _bed, (f,), value=0.01)], {}),
}


@pytest.mark.parametrize(
    "use",
    [
        pytest.param(use, marks=[pytest.mark.slow] * (use not in ("thickness", "own energy")))
        for use in USES_OF_FUNCTIONS
    ],
)
def test_functions_are_read_at_each_solve(dome: Dome, use: str) -> None:
    """A scene whose function has changed gives the numbers of a new problem.

    The largest remanence stays, since loads are over it.
    """
    size = (3,) if use == "remanence" else ()
    f = fem.Function(fem.functionspace(dome[0], ("Lagrange", 1, size)))
    f.x.array[:] = 0.06 if size else 1.0

    def problem() -> Any:
        parts, keys = USES_OF_FUNCTIONS[use](f)
        return ms.Problem(shell(dome, **keys), ms.Clamped("rim"), *parts, PRESSED, degree=3)

    def observations(scene: Any) -> list[dict[str, float]]:
        return [scene.observe(record.point.state) for record in ms.follow(scene)]

    scene = ms.Model(problem(), MPI.COMM_SELF)
    before = observations(scene)
    f.x.array[: len(f.x.array) // 2] *= 0.9
    after = observations(scene)
    close(after, observations(ms.Model(problem(), MPI.COMM_SELF)))
    assert after[-1]["volume_change"] != pytest.approx(before[-1]["volume_change"], rel=1e-6)


@pytest.mark.parametrize("use", ["thickness", "own energy"])
def test_constants_are_read_at_each_solve(dome: Dome, use: str) -> None:
    constant = fem.Constant(dome[0], 1.0)
    parts, keys = USES_OF_FUNCTIONS[use](constant)
    scene = ms.Scene(
        ms.Problem(shell(dome, **keys), ms.Clamped("rim"), *parts, PRESSED, degree=3),
        MPI.COMM_SELF,
    )
    constant.value = 0.9
    parts, keys = USES_OF_FUNCTIONS[use](0.9 if parts else "0.9")
    wanted = ms.Scene(
        ms.Problem(shell(dome, **keys), ms.Clamped("rim"), *parts, PRESSED, degree=3),
        MPI.COMM_SELF,
    )
    close(
        *([one.observe(record.point.state) for record in ms.follow(one)] for one in (scene, wanted))
    )


def test_the_displacement_as_a_function(dome: Dome) -> None:
    """On the user's mesh, in its lengths: at the pole, and at the rim."""
    scene = ms.Scene(ms.Problem(shell(dome), ms.Clamped("rim"), PRESSED), MPI.COMM_SELF)
    assert not scene.problem.is_half
    *_, record = ms.follow(scene)
    u = record.u
    assert u.function_space.mesh is dome[0]
    assert u.function_space.element.basix_element.degree == 4
    places = u.function_space.tabulate_dof_coordinates()
    values = u.x.array.reshape(-1, 3)
    assert values[np.argmax(places[:, 2])] == pytest.approx(
        R * scene.model.displacement(record.point.state.u, "pole"), abs=1e-8
    )
    assert np.abs(values[np.abs(places[:, 2]) < 1e-9]).max() == 0
    pushed = R * scene.model.domain.mesh.comm.allreduce(np.abs(record.point.state.u).max())
    assert np.abs(values).max() == pytest.approx(pushed, rel=1e-12)
    *_, traced = ms.trace(scene, "pressure", targets=[0.1])
    assert 0 < np.abs(traced.u.x.array).max() < pushed


def flat(cell: str, dimension: int = 3) -> mesh.Mesh:
    """Two cells, or one."""
    places = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])[:, :dimension]
    cells = [[0, 1, 2, 3]] if cell == "quadrilateral" else [[0, 1, 2], [1, 3, 2]]
    element = basix.ufl.element("Lagrange", cell, 1, shape=(dimension,))
    return mesh.create_mesh(MPI.COMM_SELF, np.array(cells), x=places, e=element)


@pytest.mark.parametrize(
    ("domain", "keys", "said"),
    [
        (
            flat("quadrilateral"),
            {},
            "mesh: its cells are of the kind quadrilateral; a mid-surface has triangles",
        ),
        (
            flat("triangle", 2),
            {},
            "mesh: its nodes have 2 coordinates; a mid-surface is in space: gdim=3",
        ),
        (
            flat("triangle"),
            {"edges": {"rim": 1}},
            "edges.rim: 1: is a value of tags: give facet_tags",
        ),
    ],
)
def test_other_meshes_are_refused(domain: mesh.Mesh, keys: Mapping[str, Any], said: str) -> None:
    with pytest.raises(MeshError, match=re.escape(said)):
        ms.Shell(domain, thickness=0.01, poisson_ratio=0.3, **keys)


def test_what_does_not_fit_is_refused(dome: Dome) -> None:
    domain, facet_tags, _ = dome
    with pytest.raises(MeshError, match=r"edges\.rim: 7: facet_tags have no such value, only 2"):
        ms.Shell(domain, edges={"rim": 7}, facet_tags=facet_tags, **MATERIAL)
    assert list(
        ms.Problem(ms.Shell(domain, **MATERIAL), ms.Clamped("rest")).triangulated().edges
    ) == ["rest"]
    elsewhere = fem.Function(fem.functionspace(flat("triangle"), ("Lagrange", 1)))
    with pytest.raises(
        MeshError, match=r"shell.thickness_factor: is a function on another mesh than that"
    ):
        ms.Problem(shell(dome, thickness_factor=elsewhere), ms.Clamped("rim"))
    with pytest.raises(
        MeshError, match=r"is a function of Basix element \(N1E.*; allowed are Lagrange and DG"
    ):
        ms.Problem(
            shell(dome), ms.Field(fem.Function(fem.functionspace(domain, ("N1curl", 1))), [0, 0, 1])
        )
    fine = function(dome, ("Lagrange", 5), lambda x: 1 + 0 * x[0])
    with pytest.raises(
        MeshError, match=r"thickness_factor: is a function of degree 5; allowed is at most .* 4"
    ):
        ms.Scene(ms.Problem(shell(dome, thickness_factor=fine), ms.Clamped("rim")), MPI.COMM_SELF)
    with pytest.raises(ms.CaseError, match="is a function; that needs a shell on a dolfinx mesh"):
        ms.Problem(
            ms.Shell(
                "hemisphere", radius_to_thickness=50, poisson_ratio=0.3, thickness_factor=elsewhere
            )
        )
    with pytest.raises(
        ms.CaseError, match=r"Problem: shell.poisson_ratio: 0.7: must be less than or equal to 0.5"
    ):
        ms.Problem(
            ms.Shell("hemisphere", radius_to_thickness=50, poisson_ratio=0.7), ms.Clamped("equator")
        )
    with pytest.raises(ms.CaseError, match=r"Problem: 'rim': allowed are what ms.Clamped"):
        ms.Problem(shell(dome), "rim")  # type: ignore[arg-type]
    term = ms.OwnTerm("bed", lambda r0, u, k: k * ufl.dot(u.r, u.r), (elsewhere,))
    with pytest.raises(MeshError, match=r"terms: bed: a function on a mesh: that is of a problem"):
        ms.Scene(CASES / "dimple_buckling.yaml", terms=[term])


def cap(*parts: Any, **sections: Any) -> Any:
    """A problem without a mesh, of which only the words count."""
    shell = ms.Shell("cap", polar=40, radius=1.0, thickness=0.02, poisson_ratio=0.3)
    return ms.Problem(shell, ms.Clamped("rim"), *parts, **sections)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        (
            lambda: ms.Shell("cap", thicknes=0.1),
            "Problem: shell.thicknes: unknown key; did you mean thickness?",
        ),
        (
            lambda: ms.Shell("strip", widht=0.1),
            "Problem: shell.widht: unknown key; did you mean width?",
        ),
        (lambda: ms.Shell("hemisfere"), "unknown geometry; did you mean hemisphere?"),
        (lambda: ms.Step("indentaton"), "unknown kind of step; did you mean indentation?"),
        (lambda: ms.Pressure(pint=3), "Problem: loading.pint: unknown key; did you mean points?"),
        (
            lambda: ms.Force("tip", dept=3),
            "Problem: loading.dept: unknown key; did you mean depth?",
        ),
        (lambda: ms.Section("fundation", stiffness=1), "unknown section; did you mean foundation?"),
        (lambda: ms.Section("foundation", stifness=1), "unknown key; did you mean stiffness?"),
    ],
)
def test_a_slip_is_refused_where_it_is_written(written: Callable[[], Any], said: str) -> None:
    """Not by the problem, which may be made far from there."""
    with pytest.raises(ms.CaseError, match=re.escape(said)):
        written()


def test_what_is_given_twice_is_refused() -> None:
    """The later of two values would win without a word."""
    field = ms.Field([0, 0, 1], [1, 0, 0], lambda_m=1e-3)
    twice = [
        ((ms.Hinged("rim"),), {}, "boundary.rim: is given twice, as clamped and as hinged"),
        (
            (field, ms.Field([0, 0, 1], [1, 0, 0], lambda_m=2e-3)),
            {},
            "magnetic.lambda_m: is given twice, as 0.001 and",
        ),
        (
            (ms.Section("shell", poisson_ratio=0.4),),
            {},
            "shell.poisson_ratio: is given twice, as 0.3 and as 0.4",
        ),
        (
            (ms.Pressure(),),
            {"loading": {"kind": "pressure"}},
            "loading: is given twice, as steps and as a section",
        ),
        ((), {"degree": 3, "mesh": {"degree": 4}}, "mesh.degree: is given twice, as 4 and as 3"),
        ((), {"degree": 3, "mesh": 1}, "mesh: 1: must be a section, with keys below it"),
    ]
    for parts, sections, said in twice:
        with pytest.raises(ms.CaseError, match=rf"^Problem: {re.escape(said)}"):
            cap(*parts, **sections)
    assert cap(field, field, ms.Clamped("rim")).lambda_m == 1e-3


def test_a_vector_that_is_zero_has_no_direction() -> None:
    """With `lambda_m` vectors are over their magnitudes: zero is no field, and not one along e3."""

    def pulled(remanent: Any, applied: Any) -> float:
        *_, record = ms.follow(
            cap(ms.Field(remanent, applied, lambda_m=1e-3), ms.Step("field", points=1))
        )
        return float(np.abs(record.point.state.u).max())

    assert pulled([0, 0, 1], [0, 0, 1]) > 1e-4
    assert pulled([0, 0, 0], [0, 0, 1]) < 1e-15
    assert pulled([0, 0, 1], np.zeros(3)) < 1e-15


def test_what_is_no_vector_and_no_shell(dome: Dome) -> None:
    for vector in (1.0, None, [0, 1], np.eye(3)):
        with pytest.raises(
            ms.CaseError,
            match=r"^Problem: magnetic\.remanent: .*: a vector has three|numbers or form",
        ):
            cap(ms.Field(vector, [0, 0, 1], lambda_m=1e-3))
    with pytest.raises(ms.CaseError, match=r"magnetic\.lambda_m: 'abc': must be a valid number"):
        cap(ms.Field([0, 0, 1], [0, 0, 1], lambda_m="abc"))  # type: ignore[arg-type]
    with pytest.raises(ms.CaseError, match=r"the first argument is what ms\.Shell gives"):
        ms.Problem(dome[0], ms.Clamped("rim"))  # type: ignore[arg-type]
    with pytest.raises(
        ms.CaseError, match=r"shell\.geometry: the surface is the mesh; leave it out"
    ):
        shell(dome, geometry="disc")
    one = function(dome, ("Lagrange", 1), lambda x: 1 + 0 * x[0])
    with pytest.raises(
        ms.CaseError, match=r"^Problem: foundation\.factor: a function on the mesh: must be"
    ):
        ms.Problem(
            shell(dome), ms.Clamped("rim"), ms.Section("foundation", stiffness=1.0, factor=one)
        )


def test_terms_whose_value_is_none() -> None:
    def bed(r0: Any, u: Any) -> Any:
        return ufl.dot(u.r, u.r) / 2

    for value in (np.nan, np.inf, "1e-4", None):
        with pytest.raises(ValueError, match=r"bed: value: .*: must be a finite number"):
            ms.OwnTerm("bed", bed, value=value)
    with pytest.raises(ValueError, match=r"bed: on: \['a', 'b'\]: must be the name of one edge"):
        ms.OwnTerm("bed", bed, on=["a", "b"])  # type: ignore[arg-type]
    assert ms.OwnTerm("bed", bed, value=np.float64(2)).value == 2


def folds(folder: Path, ranks: int) -> tuple[float, float]:
    """Pressure at the fold and integral of |u|^2 there, of the program in howto.md."""
    (program,) = re.findall(
        r"```python\n(import gmsh\n.*?)```", HOWTO.read_text("utf-8"), re.DOTALL
    )
    assert program.count("\n") <= 30
    program += """
from dolfinx.fem import assemble_scalar, form
size = comm.allreduce(assemble_scalar(form(ufl.inner(record.u, record.u) * ufl.dx)))
if comm.rank == 0:
    print("fold at", record.label, record.point.state.mu["pressure"], size)
"""
    (folder / "program.py").write_text(program, "utf-8")
    command = [*(mpirun(ranks) if ranks > 1 else []), sys.executable, "program.py"]
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert (folder / "fold.bp").exists()
    (found,) = re.findall(r"fold at fold (\S+) (\S+)", done.stdout)
    return float(found[0]), float(found[1])


@pytest.mark.slow
def test_the_program_of_the_howto_on_one_and_two_ranks(tmp_path: Path) -> None:
    for ranks in (1, 2):
        (tmp_path / str(ranks)).mkdir()
    one, two = (folds(tmp_path / str(ranks), ranks) for ranks in (1, 2))
    assert two == pytest.approx(one, rel=1e-7)


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ({"radius": "25 mm", "thickness": "2 mm"}, "times as long as radius, 25 mm: give unit="),
        ({"thickness": "2 mm"}, "e+04 times as long as thickness, 2 mm: give unit="),
        ({"thickness": "25 m"}, "2 times as long as thickness"),
        ({"thickness": "2 mm", "unit": "m"}, ""),
        ({"radius": "25 mm", "thickness": "2 mm", "unit": "mm"}, ""),
        (
            {"radius": "10 m", "thickness": "2 mm", "unit": "mm"},
            "mm, 0.005 times as long as radius, 10 m: give another unit, or leave the radius out",
        ),
        ({"radius": "25 m", "thickness": "0.2 m"}, ""),
        ({"radius": 25, "thickness": 2}, ""),
        ({"radius": "-25 mm", "thickness": "2 m"}, ""),
    ],
)
def test_a_mesh_in_mm_is_not_in_metres(dome: Dome, sizes: dict[str, Any], message: str) -> None:
    """The dome is 50 wide; only its unit says of what."""
    domain, facet_tags, _ = dome
    keys = {
        "edges": {"rim": 2},
        "facet_tags": facet_tags,
        "youngs_modulus": "1 MPa",
        "poisson_ratio": 0.4,
        **sizes,
    }
    if not message:
        ms.Shell(domain, **keys)
        return
    with pytest.raises(ms.CaseError) as error:
        ms.Shell(domain, **keys)
    assert ("shell.unit: is not given" in str(error.value)) == ("unit" not in sizes)
    assert message in str(error.value)
