"""Random pushes of a sheet that folds on itself: how often it intersects itself at an accepted point, by an independent
test of triangles. A line for each push; those in the table are not done again.

python3 cases/benchmarks/pushes.py [--pushes 200] [--first 0] [--table pushes.csv]
"""

import argparse
import csv
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Stopped

Array = NDArray[np.float64]
h, WIDTH, CELLS = 0.03, 0.25, 8  # thickness, width and cells along a sheet of unit length
PARTS = 8  # of a cell's side, for the test of triangles


@dataclass(frozen=True)
class Push:
    """What a push has come to.

    Attributes
    ----------
    points, touching
        How many were accepted, and at how many of them the sheet touches itself.
    crossings
        Sides of triangles that pass through others, of all points.
    factor
        The part of the motion that was reached.
    stopped
        Why it is no more; empty if it is all.
    """

    seed: int
    points: int
    touching: int
    crossings: int
    factor: float
    seconds: float
    stopped: str


def crossings(one: Array, other: Array, apart: NDArray[np.bool_] | None = None) -> int:
    """How many sides of triangles (n, 3, 3) pass through other triangles (m, 3, 3), of the pairs (n, m) that count."""
    found = 0
    for a, b, counts in ((one, other, apart), (other, one, None if apart is None else apart.T)):
        p = a.reshape(-1, 1, 3)
        d = a[:, [1, 2, 0]].reshape(-1, 1, 3) - p
        e1, e2 = b[None, :, 1] - b[None, :, 0], b[None, :, 2] - b[None, :, 0]
        normal = np.cross(d, e2)
        det = np.sum(normal * e1, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = p - b[None, :, 0]
            u = np.sum(s * normal, axis=-1) / det
            q = np.cross(s, e1)
            v = np.sum(q * d, axis=-1) / det
            t = np.sum(q * e2, axis=-1) / det
            inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)
        found += int(np.sum(inside if counts is None else inside & np.repeat(counts, 3, axis=0)))
    return found


def triangles(scene: Scene, u: Array, cells: NDArray[np.int32]) -> Array:
    """Flat triangles (n, 3, 3), `PARTS`^2 of each of some cells (cells, functions)."""
    model, n = scene.model, PARTS
    X = np.array([(i, j) for j in range(n + 1) for i in range(n + 1 - j)]) / n
    number = {(i, j): k for k, (i, j) in enumerate((i, j) for j in range(n + 1) for i in range(n + 1 - j))}
    low = [(number[i, j], number[i + 1, j], number[i, j + 1]) for j in range(n) for i in range(n - j)]
    high = [(number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]) for j in range(n) for i in range(n - j - 1)]
    shape = model.V.element.basix_element.tabulate(0, X)[0, :, :, 0]
    r = (model.r0.x.array + u).reshape(-1, 3)[cells]
    return np.asarray(np.einsum("mk,nki->nmi", shape, r)[:, low + high].reshape(-1, 3, 3))


def sheet(file: Path) -> Path:
    """A mesh file of a sheet with the edges left and right, and the rest of its edge."""
    x = np.linspace(0, 1, CELLS + 1)
    nodes = [(a, b, 0.0) for b in (0.0, WIDTH) for a in x]
    lines, elements, n = list[tuple[int, int, int]](), list[str](), CELLS + 1
    for i in range(1, n):
        p, q, r, s = i, i + 1, n + i + 1, n + i
        corners = ((p, q, r), (p, r, s)) if i % 2 else ((p, q, s), (q, r, s))
        elements += [f"2 2 1 1 {a} {b} {c}" for a, b, c in corners]
        lines += [(4, p, q), (4, s, r)]
    elements += [f"1 2 {k} {k} {a} {b}" for k, a, b in [(2, 1, n + 1), (3, n, 2 * n), *lines]]
    text = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", "4"]
    text += ['2 1 "sheet"', '1 2 "left"', '1 3 "right"', '1 4 "sides"', "$EndPhysicalNames"]
    text += ["$Nodes", str(len(nodes)), *(f"{i} {a} {b} {c}" for i, (a, b, c) in enumerate(nodes, 1)), "$EndNodes"]
    text += ["$Elements", str(len(elements)), *(f"{i} {e}" for i, e in enumerate(elements, 1)), "$EndElements"]
    file.write_text("\n".join(text) + "\n", encoding="utf-8")
    return file


def case(file: Path, seed: int) -> Case:
    """A sheet whose right end is turned over by about half a turn, and pressed on the sheet and past it."""
    rng = np.random.default_rng(seed)
    axis = np.array([0.0, -1.0, 0.0]) + rng.uniform(-0.15, 0.15, 3) * [1, 0, 1]
    move = {
        "supports": ["right"],
        "rotation": {
            "axis": [float(a) for a in axis], "point": [float(rng.uniform(0.6, 0.75)), WIDTH / 2, 0],
            "angle": float(rng.uniform(180, 300)),
        },
        "translation": [0, float(rng.uniform(-0.1, 0.1)), float(h * rng.uniform(-8, -2))],
    }  # fmt: skip
    return Case.model_validate(
        {
            "shell": {
                "geometry": "mesh", "file": str(sheet(file)), "radius": 1, "thickness": h, "youngs_modulus": 1,
                "poisson_ratio": 0.3,
            },
            "boundary": {"left": "clamped", "right": "clamped"},
            "contact": [["shell", "shell"]],
            "mesh": {"degree": 3},
            "loading": {"kind": "edge", "control": "load", "points": 1, "factor": 1, "moves": [move]},
        }
    )  # fmt: skip


def push(folder: Path, seed: int, seen: Callable[[float], object] = lambda factor: None) -> Push:
    """One push; `seen` gets its progress."""
    begun, scene = time.process_time(), Scene(case(folder / "sheet.msh", seed))
    model = scene.model
    cells = model.V.dofmap.list
    corners = cells[:, :3]  # vertices come first
    meet = (corners[:, None, :, None] == corners[None, :, None, :]).any(axis=(2, 3))
    apart = np.triu(np.repeat(np.repeat(~meet, PARTS**2, axis=0), PARTS**2, axis=1))
    points, touching, passed, factor, stopped = 0, 0, 0, 0.0, ""
    try:
        for record in follow(scene):
            state = record.point.state
            at = triangles(scene, model.system.with_ghosts(state.u, state.mu), cells)
            passed += crossings(at, at, apart)
            touching += scene.observe(state)["contact_force"] > 0
            points, factor = points + 1, state.mu["motion"]
            seen(factor)
    except Stopped as e:
        stopped = str(e)
    return Push(seed, points, touching, passed, factor, time.process_time() - begun, stopped)


def pushes(seeds: range, table: Path) -> Iterator[Push]:
    """The pushes of some seeds that a table does not have, which they are added to."""
    done = set[int]()
    if table.exists():
        with table.open(encoding="utf-8") as file:
            done = {int(row["seed"]) for row in csv.DictReader(file)}
    for seed in seeds:
        if seed in done:
            continue
        with TemporaryDirectory() as folder:
            pushed = push(Path(folder), seed, partial(print, f"\r{seed}:", end="", flush=True))
        new = not table.exists()
        with table.open("a", encoding="utf-8", newline="") as file:
            rows = csv.writer(file)
            if new:
                rows.writerow(each.name for each in fields(Push))
            rows.writerow(asdict(pushed).values())
        yield pushed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pushes", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--table", type=Path, default=Path("pushes.csv"))
    given = parser.parse_args()
    for pushed in pushes(range(given.first, given.first + given.pushes), given.table):
        print("\r", *asdict(pushed).values(), flush=True)
