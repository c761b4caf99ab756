"""Meshes of programs: what is given with them, parts of other meshes, and the side of their
normals.
"""

import ast
import subprocess
import sys
from pathlib import Path
from typing import Any

import basix.ufl
import numpy as np
import pytest
from command import mpirun
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.msh import oriented
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.mesh.user_mesh import UserMesh

Array = NDArray[np.float64]
Cells = NDArray[np.int64]


def plate(columns: int, length: float = 1.0) -> tuple[Array, Cells]:
    """Two rows of squares, each of two triangles."""
    x, y = np.meshgrid(np.linspace(0, length, columns + 1), [0.0, 0.2, 0.4], indexing="ij")
    nodes = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    a = (3 * np.arange(columns)[:, None] + np.arange(2)).ravel()
    return nodes, np.concatenate(
        [np.column_stack([a, a + 3, a + 4]), np.column_stack([a, a + 4, a + 1])]
    )


def made(nodes: Array, cells: Cells, comm: MPI.Comm = MPI.COMM_SELF) -> mesh.Mesh:
    if comm.rank > 0:
        nodes, cells = nodes[:0], cells[:0]
    return mesh.create_mesh(
        comm, cells, x=nodes, e=basix.ufl.element("Lagrange", "triangle", 1, shape=(3,))
    )


def sides(domain: mesh.Mesh) -> mesh.MeshTags:
    """All of the border under the tag 1."""
    domain.topology.create_connectivity(1, 2)
    facets = mesh.exterior_facet_indices(domain.topology)
    return mesh.meshtags(domain, 1, facets, np.ones(len(facets), dtype=np.int32))


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (np.array([10**6]), r"edges\.rim: 1000000: this process has facets 0 to 29"),
        (np.array([-1]), r"edges\.rim: -1: this process has facets"),
        (
            np.array([0.4]),
            r"edges\.rim: is neither a value of tags nor a list of local numbers of facets$",
        ),
        (
            np.ones(30, dtype=bool),
            r"edges\.rim: is neither .*: np\.flatnonzero\(\.\.\.\) of a mask",
        ),
        (1.0, r"edges\.rim: is neither a value of tags"),
        ("1", r"edges\.rim: is neither a value of tags"),
        (None, r"edges\.rim: is neither a value of tags"),
    ],
)
def test_parts_that_are_none(part: Any, said: str) -> None:
    with pytest.raises(MeshError, match=said):
        UserMesh(made(*plate(4))).triangles({"rim": part}, {})


def test_cells_that_are_none() -> None:
    for part, said in (
        ([-1], "-1: this process has cells 0 to 15"),
        (np.ones(16, dtype=bool), "is neither a value"),
    ):
        with pytest.raises(MeshError, match=rf"patches\.a: {said}"):
            UserMesh(made(*plate(4))).triangles({}, {"a": np.array(part)})
    found = UserMesh(made(*plate(4))).triangles({}, {"a": [0, 3]})  # type: ignore[dict-item]
    assert found.patches["a"].sum() == 2


def test_tags_of_another_mesh() -> None:
    domain, other = made(*plate(4)), made(*plate(9))
    with pytest.raises(
        MeshError, match=r"edges\.rim: 1: facet_tags belong to another mesh than that of the shell"
    ):
        UserMesh(domain).triangles({"rim": 1}, {}, sides(other))
    assert len(UserMesh(domain).triangles({"rim": 1}, {}, sides(domain)).edges["rim"]) == 12


def test_part_of_another_mesh() -> None:
    """It has the triangles of the same plate alone, and functions on it are known there."""
    whole = made(*plate(8, 2.0))
    near = mesh.locate_entities(whole, 2, lambda x: x[0] < 1 + 1e-9)
    part = mesh.create_submesh(whole, 2, near)[0]
    home = UserMesh(part)
    found = home.triangles({}, {})
    alone = plate(4)
    assert len(found.cells) == len(alone[1])
    assert sorted(map(tuple, found.nodes.round(9))) == sorted(map(tuple, alone[0].round(9)))
    of_x = fem.Function(fem.functionspace(part, ("Lagrange", 1)))
    of_x.interpolate(lambda x: x[0])
    centres = found.nodes[found.cells[:, :3], 0].mean(axis=1)
    assert home.field(of_x, "x").nodal.mean(axis=(1, 2)) == pytest.approx(centres)


@pytest.mark.telling
@pytest.mark.parametrize("shape", ["flat", "upright", "tube"])
def test_normals_of_equal_halves_do_not_depend_on_numbers(shape: str) -> None:
    """Half of the area turned over, as dolfinx refines meshes: up, along e2 where that decides
    nothing, outwards.
    """
    nodes, cells = plate(12)
    if shape == "upright":
        nodes = nodes[:, [0, 2, 1]]
    if shape == "tube":
        angle = 2 * np.pi * nodes[:, 0]
        nodes = np.column_stack([np.cos(angle), np.sin(angle), nodes[:, 1]])
        cells = np.where(cells >= 36, cells - 36, cells)  # the last column of nodes is the first
        nodes = nodes[:36]
    half = np.arange(len(cells)) % 2 == 1
    mixed = np.where(half[:, None], cells[:, [0, 2, 1]], cells)

    def normals(triangles: Cells) -> Array:
        a, b, c = (nodes[triangles[:, i]] for i in range(3))
        return np.cross(b - a, c - a)

    for order in (
        np.arange(len(cells)),
        np.arange(len(cells))[::-1],
        np.random.default_rng(1).permutation(len(cells)),
    ):
        for given in (mixed, mixed[:, [0, 2, 1]]):
            found = oriented(nodes, given[order])
            n, middle = normals(found), nodes[found].mean(axis=1)
            outward = {
                "flat": n[:, 2],
                "upright": n[:, 1],
                "tube": (n * middle)[:, :2].sum(axis=1),
            }[shape]
            assert (outward > 0).all()


ON_TWO = """
import sys
sys.path[:0] = sys.argv[1:]
import numpy as np
from mpi4py import MPI
from test_user_mesh import made, plate, sides
import magshell_fenicsx as ms
from magshell_fenicsx.mesh.patch import MeshError

rank = MPI.COMM_WORLD.rank
material = {"thickness": 0.01, "youngs_modulus": 1.0, "poisson_ratio": 0.3}
own = made(*plate(4))
shell = ms.Shell(own, edges={"rim": 1}, facet_tags=sides(own), **material)
pressure = ms.Pressure(pressure=1e-3, until="target", points=1)
problem = ms.Problem(shell, ms.Clamped("rim"), pressure, degree=2)
*_, record = ms.follow(ms.Scene(problem))
*_, spread = ms.follow(ms.Scene(problem, MPI.COMM_WORLD))
said = []
for refused in (lambda: spread.u, lambda: ms.Shell(shared, edges={"rim": numbers}, **material)):
    shared = made(*plate(4), MPI.COMM_WORLD)
    numbers = np.array([10**6 * rank])
    try:
        refused()
    except (MeshError, ValueError) as e:
        said.append(str(e))
size = float(np.abs(record.u.x.array).max())
print(MPI.COMM_WORLD.gather((size, said)) or "")
"""


@pytest.mark.slow
def test_meshes_of_one_process_and_of_two(tmp_path: Path) -> None:
    """A scene has the processes of its mesh, what one of them finds is said by all, and no part of
    u is lost.
    """
    (tmp_path / "program.py").write_text(ON_TWO)
    command = [
        *mpirun(2),
        sys.executable,
        str(tmp_path / "program.py"),
        *map(str, Path(__file__).parents[:2]),
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    one, other = ast.literal_eval(done.stdout.strip())
    assert one[0] > 1e-6
    assert other[0] == pytest.approx(one[0], rel=1e-9)
    assert other[1] == one[1]
    assert one[1][0].startswith("u: 2 processes solve the scene and the mesh belongs to 1:")
    assert one[1][1].startswith("edges.rim: 1000000: this process has facets")
