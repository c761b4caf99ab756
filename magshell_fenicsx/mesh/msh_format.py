"""Content of a file in gmsh's mesh format (MSH 2 to 4, text or binary), read safely by gmsh.

gmsh chooses how to read a file from its first line. It runs scripts (SystemCall "..."), and it also
runs a file of the same name with .opt at its end. So gmsh gets a copy in an empty folder, and only
if the first line is that of a mesh. gmsh crashes on some damaged files, so it runs in a process of
its own: this module as a program, which leaves the mesh in a file.

gmsh's words: an entity is a curve or surface of the geometry, a physical group a named set of
entities, a tag the number of a node in the file.
"""

import os
import pickle
import subprocess
import sys
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.platform.packages import Unusable, import_gmsh

Integers = NDArray[np.int64]
Blocks = list[tuple[str, int, int, Integers]]
RESULT_FILE = "found"  # what the process of its own writes
UNUSABLE = 4  # exit code where gmsh cannot be loaded


@dataclass(frozen=True)
class MshContent:
    """The mesh in a file.

    Attributes
    ----------
    tags, places
        Numbers (n,) and coordinates (n, 3) of the nodes.
    blocks
        Elements of one type on one entity: gmsh's name of the type, dimension, entity, node numbers
        (m, k).
    groups
        Dimension -> name of a physical group, or its number where it has none -> its entities.
    """

    tags: Integers
    places: NDArray[np.float64]
    blocks: Blocks = field(default_factory=list)
    groups: dict[int, dict[str, list[int]]] = field(default_factory=lambda: {1: {}, 2: {}})


@lru_cache(maxsize=1)  # the planner looks for symmetry planes in the file that is then built
def parsed(content: bytes) -> MshContent:
    """Return the mesh in the content of a file; the last result is cached.

    Raises
    ------
    MeshError
        If the file is of another kind, or damaged.
    Unusable
        If gmsh cannot be loaded.
    """
    if not content.startswith((b"$MeshFormat", b"$Comments")):
        raise MeshError(
            "is no mesh of gmsh's, which begins with $MeshFormat; allowed are versions 2 and 4, "
            "as text or binary. A script is not run here: gmsh -2 -o part.msh part.geo makes a "
            "mesh of it"
        )
    with TemporaryDirectory() as folder:
        copy = Path(folder) / "part.msh"
        copy.write_bytes(content)
        command = [sys.executable, "-m", __name__, str(copy)]
        # the process finds the modules that this one finds
        import_paths = [str(Path(__file__).parents[2]), *filter(None, sys.path)]
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(import_paths)}
        process = subprocess.run(
            command, env=env, cwd=folder, capture_output=True, text=True, check=False
        )
        # exit codes: 0 success, `UNUSABLE` without gmsh, negative after a crash
        if process.returncode == UNUSABLE:
            raise Unusable(process.stderr.strip())
        if process.returncode:
            reason = "it crashed"
            if process.returncode > 0:  # the last line of its traceback says why
                reason = (process.stderr.strip().splitlines() or ["nothing"])[-1]
            reason = reason.replace(str(copy), "the file").removeprefix("Exception: ").strip()
            raise MeshError(
                f"is damaged, or of a version that gmsh does not read, which says: {reason}"
            )
        mesh = MshContent(*pickle.loads((Path(folder) / RESULT_FILE).read_bytes()))
    if not np.isfinite(mesh.places).all():
        raise MeshError("a coordinate is not a number")
    return mesh


def _fields_of_model(
    model: Any,
) -> tuple[Integers, NDArray[np.float64], Blocks, dict[int, dict[str, list[int]]]]:
    """Return the fields of `MshContent`, in their order, for gmsh's current model."""
    tags, xyz, _ = model.mesh.getNodes()
    blocks, groups = Blocks(), dict[int, dict[str, list[int]]]({1: {}, 2: {}})
    for dim, entity in model.getEntities():
        for kind, _, nodes in zip(*model.mesh.getElements(dim, entity), strict=True):
            name, _, _, width, *_ = model.mesh.getElementProperties(kind)  # width: nodes of one
            elements = nodes.astype(np.int64).reshape(-1, width)
            # MSH 2 repeats an element for each of its groups; the order of the rest is kept
            first_index = np.unique(elements, axis=0, return_index=True)[1]
            blocks.append((name, dim, entity, elements[np.sort(first_index)]))
    for dim, group in model.getPhysicalGroups():
        if dim in groups:  # curves and surfaces
            name = model.getPhysicalName(dim, group) or str(group)
            groups[dim][name] = model.getEntitiesForPhysicalGroup(dim, group).tolist()
    return tags.astype(np.int64), xyz.reshape(-1, 3), blocks, groups


def _main(file: Path) -> None:
    """Write the fields of `MshContent` of a file beside it; the program of gmsh's own process."""
    try:
        gmsh = import_gmsh()
    except Unusable as e:
        print(e, file=sys.stderr)
        sys.exit(UNUSABLE)
    gmsh.initialize(readConfigFiles=False, interruptible=False)  # ~/.gmshrc may run commands
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.open(str(file))
    (file.parent / RESULT_FILE).write_bytes(pickle.dumps(_fields_of_model(gmsh.model)))


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
