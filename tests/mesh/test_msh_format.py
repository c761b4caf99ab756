"""Mesh files as gmsh reads them, of every version; what is none is refused, and nothing in it ever
runs.
"""

import os
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import pytest
from command import magshell
from conftest import CASES
from test_msh import CASE_FILE, panel

from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.mesh.msh_format import parsed
from magshell_fenicsx.mesh.patch import MeshError

BRACKET = CASES.parent / "meshes" / "bracket.msh"
VERSIONS = [
    (2.2, 0),
    (2.2, 1),
    (4.0, 0),
    (4.1, 0),
    (4.1, 1),
]  # and whether it is binary; gmsh writes no binary 4.0


@pytest.fixture
def writer() -> Iterator[Any]:
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    yield gmsh
    gmsh.finalize()


def write(file: Path, version: float, binary: int) -> None:
    gmsh.option.setNumber("Mesh.MshFileVersion", version)
    gmsh.option.setNumber("Mesh.Binary", binary)
    gmsh.write(str(file))


Places = dict[str, list[tuple[float, ...]]]


def by_gmsh(file: Path) -> tuple[Places, Places]:
    """Names of patches and edges -> the places of the nodes of each element, of which version 2 may
    have several.
    """
    gmsh.open(str(file))
    tags, xyz, _ = gmsh.model.mesh.getNodes()
    place = dict(zip(tags.tolist(), xyz.reshape(-1, 3), strict=True))
    found: tuple[Places, Places] = {}, {}
    for dim, tag in gmsh.model.getPhysicalGroups():
        name = gmsh.model.getPhysicalName(dim, tag) or str(tag)
        for entity in gmsh.model.getEntitiesForPhysicalGroup(dim, tag):
            for kind, _, nodes in zip(*gmsh.model.mesh.getElements(dim, entity), strict=True):
                width = gmsh.model.mesh.getElementProperties(kind)[3]
                for element in nodes.reshape(-1, width).tolist():
                    ends = (
                        element if dim == 2 else sorted(element[:2], key=lambda n: tuple(place[n]))
                    )
                    found[2 - dim].setdefault(name, []).append(
                        tuple(np.ravel([place[n] for n in ends]))
                    )
    return tuple({name: sorted(set(rows)) for name, rows in each.items()} for each in found)  # type: ignore[return-value]


def by_reader(file: Path) -> tuple[Places, Places]:
    patch = read_msh(MeshFile(file, 1.0), {})
    cells = patch.nodes[patch.cells].reshape(len(patch.cells), -1)
    patches = {
        name: sorted(map(tuple, cells[inside].tolist())) for name, inside in patch.patches.items()
    }
    edges = {
        name: sorted(tuple(np.ravel(sorted(pair))) for pair in patch.nodes[pairs].tolist())
        for name, pairs in patch.edges.items()
    }
    return patches, edges


def check_same(file: Path) -> None:
    """A curve within the surface is no edge of it."""
    (patches, edges), (others, curves) = by_reader(file), by_gmsh(file)
    for named in (edges, curves):
        named.pop("middle", None)
    assert (patches, edges) == (others, curves)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize(("version", "binary"), VERSIONS)
def test_read_as_gmsh_reads_it(
    writer: Any, tmp_path: Path, order: int, version: float, binary: int
) -> None:
    """To the last bit: nodes, triangles, patches and edges; a name with a space, one with an
    accent, one without.
    """
    panel(writer.model, order)
    writer.model.addPhysicalGroup(1, [1, 3], 77)
    writer.model.setPhysicalName(2, 7, "lower  half, flèche")
    write(tmp_path / "part.msh", version, binary)
    check_same(tmp_path / "part.msh")


@pytest.mark.parametrize(("version", "binary"), VERSIONS)
def test_nodes_with_parameters_and_parts(
    writer: Any, tmp_path: Path, version: float, binary: int
) -> None:
    """What gmsh can write besides: the place on the surface, all elements, a partition."""
    panel(writer.model, 2)
    writer.option.setNumber("Mesh.SaveParametric", float(version > 4))
    writer.model.mesh.partition(3)
    write(tmp_path / "part.msh", version, binary)
    check_same(tmp_path / "part.msh")


def test_an_element_in_two_groups_is_one(writer: Any, tmp_path: Path) -> None:
    """Version 2 has it twice, version 4 once."""
    panel(writer.model, 1)
    writer.model.addPhysicalGroup(2, [1, 2], name="all")
    found = []
    for version in (2.2, 4.1):
        write(tmp_path / "part.msh", version, 0)
        found.append(by_reader(tmp_path / "part.msh"))
    assert found[0] == found[1]


RUN = 'SystemCall "touch ran";\n'
SCRIPTS = {
    "a script": RUN,
    "comments before it": f"// a mesh\n/* $MeshFormat */\n{RUN}",
    "another file": 'Include "hidden.geo";\n',
    "a file merged": 'Merge "hidden.geo";\n',
    "blank lines before it": f"\n\n{RUN}",
    "an option": f"General.Terminal = 0;\n{RUN}",
    "after a format": f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{RUN}",
    "after a comment": f"$Comments\n$MeshFormat\n$EndComments\n{RUN}",
    "after a view": f'$PostFormat\n1.4 0 8\n$EndPostFormat\n{RUN}',
    "a view": f'View "v" {{ T3(0,0,0){{"x"}}; }};\n{RUN}',
    "another extension's content": "solid\nendsolid\n" + RUN,
    "python": "open('ran', 'w')\n",
}  # fmt: skip


@pytest.mark.parametrize("name", SCRIPTS)
@pytest.mark.parametrize("end", ["msh", "geo"])
def test_a_script_is_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, end: str
) -> None:
    """Whatever it is called; gmsh.open runs most of these."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "hidden.geo").write_text(RUN, encoding="utf-8")
    (tmp_path / f"part.{end}").write_text(SCRIPTS[name], encoding="utf-8")
    said = "is no mesh of gmsh's, which begins with|is damaged|there is no mesh in it"
    with pytest.raises(MeshError, match=rf"part\.\w+: ({said})"):
        read_msh(MeshFile(tmp_path / f"part.{end}", 1.0), {})
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "more", [RUN, f"$Script\n{RUN}$EndScript\n", f"$Comments\n{RUN}", f"$PostFormat\n{RUN}"]
)
def test_a_script_at_the_end_of_a_mesh(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: str
) -> None:
    """Is not looked at, nor is a section that nobody knows."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.msh").write_text(BRACKET.read_text(encoding="utf-8") + more, encoding="utf-8")
    assert len(read_msh(MeshFile(tmp_path / "part.msh", 1.0), {}).cells) == 36
    assert not (tmp_path / "ran").exists()


def test_options_beside_a_mesh_are_not_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """gmsh.open runs part.msh.opt after part.msh."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.msh").write_bytes(BRACKET.read_bytes())
    (tmp_path / "part.msh.opt").write_text(RUN, encoding="utf-8")
    assert len(read_msh(MeshFile(tmp_path / "part.msh", 1.0), {}).cells) == 36
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("command", ["check", "run"])
def test_what_the_user_sees(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str) -> None:
    """One line with the files, the key and what is allowed, exit code 2."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "part.msh").write_text(RUN, encoding="utf-8")
    (tmp_path / "case.yaml").write_text(CASE_FILE, encoding="utf-8")
    done = magshell(command, tmp_path / "case.yaml")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    said = f"{tmp_path}/case.yaml:2: shell.file: {tmp_path}/parts/part.msh: is no mesh of gmsh's"
    assert done.stderr.startswith(f"{said}, which begins with $MeshFormat; ")
    assert not (tmp_path / "ran").exists()


MESH = BRACKET.read_text(encoding="utf-8")
DAMAGED = [
    (
        MESH.replace("4.1 0 8", "1 0 8"),
        "is damaged, or of a version that gmsh does not read, which says: Error loading",
    ),
    (MESH.replace("$EndNodes", ""), "it has no triangles: put the surface in a physical group"),
    (
        MESH.replace("$Elements\n", "$Elements\n9"),
        "is damaged, or .* which says: Could not read elements",
    ),
    (MESH.replace("\n0 0.4 0\n", "\n0 nan 0\n"), "a coordinate is not a number"),
    (
        MESH.replace("\n0 0.4 0\n", "\n0 O.4 0\n"),
        "is damaged, or .* which says: Could not read nodes",
    ),
    (MESH[: MESH.index("$Nodes")], "there is no mesh in it"),
]


@pytest.mark.parametrize(("content", "said"), DAMAGED, ids=range(len(DAMAGED)))
def test_damaged_files_are_refused(tmp_path: Path, content: str, said: str) -> None:
    (tmp_path / "part.msh").write_text(content, encoding="utf-8")
    with pytest.raises(MeshError, match=rf"part\.msh: {said}"):
        read_msh(MeshFile(tmp_path / "part.msh", 1.0), {})


def test_a_crash_of_gmsh_is_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It reads in a process of its own, which some damaged files bring down."""
    crash = tmp_path / "python"
    crash.write_text("#!/bin/sh\nkill -SEGV $$\n", encoding="utf-8")
    crash.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(crash))
    with pytest.raises(MeshError, match=r"is damaged, or .* which says: it crashed"):
        parsed(BRACKET.read_bytes())


@pytest.mark.parametrize(("version", "binary"), VERSIONS)
def test_no_damage_is_a_traceback(writer: Any, tmp_path: Path, version: float, binary: int) -> None:
    """Cut off, which is never read, overwritten or repeated at random places: a message in words,
    if it is refused.
    """
    panel(writer.model, 1, 0.5)
    write(tmp_path / "part.msh", version, binary)
    rng, whole = random.Random(1), (tmp_path / "part.msh").read_bytes()
    at, other = rng.randrange(len(whole)), rng.randrange(len(whole))
    flipped = bytes([rng.randrange(256)])
    said = list[str]()
    for broken in (whole[:at], whole[:at] + flipped + whole[at + 1 :], whole[:at] + whole[other:]):
        (tmp_path / "part.msh").write_bytes(broken)
        try:
            read_msh(MeshFile(tmp_path / "part.msh", 1.0), {})
        except MeshError as e:
            said.append(str(e))
        else:
            said.append("")
    assert said[0]
    for message in filter(None, said):
        assert re.search(r"part\.msh: \S", message)
        assert not re.search(r"\w(Error|Exception):|Traceback", message)


def test_settings_of_the_user_are_not_run(tmp_path: Path) -> None:
    """Nor do they change meshes: a case is all that a result depends on."""
    found = []
    for text in ("", f'SystemCall "touch {tmp_path}/ran";\nMesh.Algorithm = 8;\n'):
        (tmp_path / ".gmshrc").write_text(text, encoding="utf-8")
        tests = str(CASES.parent / "tests")
        told = {
            **os.environ,
            "HOME": str(tmp_path),
            "PYTHONPATH": os.pathsep.join([tests, *sys.path]),
        }
        code = "from conftest import disc; print(disc(0.5).mesh.geometry.x.tolist())"
        found.append(subprocess.check_output([sys.executable, "-c", code], env=told))
    assert found[0] == found[1]
    assert not (tmp_path / "ran").exists()
