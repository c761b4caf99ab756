"""Random pushes of a sheet that folds on itself and of a disc that crumples: where each stops and
why, the smallest gap, and how often the shell intersects itself at an accepted point, by an
independent test of triangles.

A line for each push in the table; those that it has are not done again. At the end their counts.

PYTHONPATH=cases python3 -m benchmarks.pushes [--pushes 200] [--first 0] [--table pushes.csv]
"""

import argparse
import csv
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Stopped

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
h, WIDTH, CELLS = 0.03, 0.25, 8  # thickness, width and cells along a sheet of unit length
RADIUS, RINGS = 0.4, 2  # of a disc
SHEETS = 150  # the pushes before this one are of sheets
PARTS = 8  # of a side of a cell, for the test of triangles
HALVED = 3  # times, where triangles are nearer than h
NEAR = 1.5 * h  # between mid-surfaces: farther triangles are not looked at
APART = 5 * h  # within the undeformed shell: nearer triangles are of one fold
FOLD = "load control cannot pass the fold"  # how a stop is explained by a limit point


@dataclass(frozen=True)
class Push:
    """What a push has come to.

    Attributes
    ----------
    factor
        The part of the motion that was reached.
    why
        It stopped there: "target" is all of it, "fold" a limit point of the load, "failed" what is
        not explained.
    points, touching
        How many were accepted, and at how many of them the shell touches itself.
    gap
        The smallest between faces, over h, of all points; nan if none is near. Triangles are flat,
        which makes it wrong by up to a thousandth.
    intersections
        Pairs of triangles that pass through each other, of all points.
    said
        The message, if it failed.
    """

    push: int
    kind: str
    factor: float
    why: str
    points: int
    touching: int
    gap: float
    intersections: int
    seconds: float
    said: str


def passing(one: Array, other: Array) -> NDArray[np.bool_]:
    """Whether a side of one of two triangles (n, 3, 3) passes through the other one."""
    found = np.zeros(len(one), dtype=bool)
    for a, b in ((one, other), (other, one)):
        e1, e2 = (b[:, None, k] - b[:, None, 0] for k in (1, 2))
        d, s = a[:, [1, 2, 0]] - a, a - b[:, None, 0]
        normal, q = np.cross(d, e2), np.cross(s, e1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, t = (
                np.sum(x * y, axis=-1) / np.sum(normal * e1, axis=-1)
                for x, y in ((s, normal), (q, d), (q, e2))
            )
            found |= ((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1)).any(axis=1)
    return found


def distances(one: Array, other: Array) -> Array:
    """Of two triangles (n, 3, 3) that do not pass through each other, each side of some length."""
    least = np.full(len(one), np.inf)
    for i, j in product(range(3), range(3)):  # two sides
        p, q, d, e = (
            one[:, i],
            other[:, j],
            one[:, i - 1] - one[:, i],
            other[:, j - 1] - other[:, j],
        )
        dd, ee, de, r = *(np.sum(x * y, axis=1) for x, y in ((d, d), (e, e), (d, e))), p - q
        square = np.maximum(dd * ee - de**2, 1e-12 * dd * ee)
        s = np.clip((de * np.sum(e * r, axis=1) - ee * np.sum(d * r, axis=1)) / square, 0, 1)
        t = np.clip((de * s + np.sum(e * r, axis=1)) / ee, 0, 1)
        s = np.clip((de * t - np.sum(d * r, axis=1)) / dd, 0, 1)
        least = np.minimum(least, np.linalg.norm(r + s[:, None] * d - t[:, None] * e, axis=1))
    for a, b in ((one, other), (other, one)):  # a corner above the other one's plane
        sides = np.stack([b[:, 1] - b[:, 0], b[:, 2] - b[:, 0]], axis=1)
        normal = np.cross(sides[:, 0], sides[:, 1])
        r = a - b[:, :1]
        X = np.einsum("nki,nil->nkl", r, np.linalg.pinv(sides))
        above = (X >= 0).all(axis=2) & (X.sum(axis=2) <= 1)
        away = np.abs(np.einsum("nki,ni->nk", r, normal / np.linalg.norm(normal, axis=1)[:, None]))
        least = np.minimum(least, np.where(above, away, np.inf).min(axis=1))
    return least


def triangles() -> Array:
    """Parts (`PARTS`^2, 3, 2) of the reference triangle."""
    steps = [(i, j) for j in range(PARTS) for i in range(PARTS - j)]
    low = [[(i, j), (i + 1, j), (i, j + 1)] for i, j in steps]
    high = [[(i + 1, j), (i + 1, j + 1), (i, j + 1)] for i, j in steps if i + j < PARTS - 1]
    return np.array(low + high) / PARTS


def quarters(X: Array) -> Array:
    """Four parts (n, 4, 3, 2) of each of some triangles."""
    a, b, c = X[:, 0], X[:, 1], X[:, 2]
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = [
        np.stack(each, axis=1) for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    ]
    return np.stack(parts, axis=1)


@dataclass(frozen=True)
class Surface:
    """The mid-surface of a scene, undeformed or at a displacement; its triangles have their corners
    on it.
    """

    scene: Scene
    r: Array

    @classmethod
    def of(cls, scene: Scene, u: Array | float = 0.0) -> "Surface":
        """At the displacement of all nodes."""
        return cls(scene, (scene.model.r0.x.array + u).reshape(-1, 3))

    def at(self, cell: Ints, X: Array) -> Array:
        """The places (n, 3, 3) of the corners (n, 3, 2) in cells (n,)."""
        V = self.scene.model.V
        shape = V.element.basix_element.tabulate(0, X.reshape(-1, 2))[0, :, :, 0].reshape(
            *X.shape[:2], -1
        )
        return np.asarray(np.einsum("nmk,nki->nmi", shape, self.r[V.dofmap.list[cell]]))


def looked_at(now: Surface, before: Surface) -> tuple[int, float]:
    """How many triangles, not near in the undeformed shell, pass through each other; their least
    distance.

    Where that is less than h, both are halved, and again, for triangles are flat and may be nearer
    than the surface.
    """
    cells = len(now.scene.model.V.dofmap.list)
    cell, X = np.repeat(np.arange(cells), PARTS**2), np.tile(triangles(), (cells, 1, 1))
    at, flat = now.at(cell, X), before.at(cell, X)
    middle = at.mean(axis=1)
    size = np.linalg.norm(at - middle[:, None], axis=2).max()
    i, j = scipy.spatial.cKDTree(middle).query_pairs(2 * size + NEAR, output_type="ndarray").T
    apart = np.linalg.norm((flat[i] - flat[j]).mean(axis=1), axis=1) > APART
    i, j = i[apart], j[apart]
    away = distances(at[i], at[j])
    least, one, other = away.min(initial=np.inf), (cell[i], X[i]), (cell[j], X[j])
    for _ in range(HALVED):
        near = away < h
        if not near.any():
            break
        rest = away[~near].min(initial=np.inf)
        (a, Xa), (b, Xb) = ((c[near], quarters(Y[near])) for c, Y in (one, other))
        one = np.repeat(a, 16), np.repeat(Xa, 4, axis=1).reshape(-1, 3, 2)
        other = np.repeat(b, 16), np.tile(Xb, (1, 4, 1, 1)).reshape(-1, 3, 2)
        away = distances(now.at(*one), now.at(*other))
        least = min(rest, away.min())
    return int(passing(at[i], at[j]).sum()), float(least)


def mesh(
    file: Path, nodes: Array, cells: Sequence[Sequence[int]], held: Callable[[Array], str]
) -> Path:
    """A mesh file of flat triangles; `held` names a part of the edge by the middle of a side."""
    sides = Counter(tuple(sorted((c[k - 1], c[k]))) for c in cells for k in range(3))
    edge = {side: held(nodes[[*side]].mean(axis=0)) for side, times in sides.items() if times == 1}
    names = sorted({*edge.values()})
    elements = [f"2 2 1 1 {a + 1} {b + 1} {c + 1}" for a, b, c in cells]
    for (a, b), name in edge.items():
        elements.append("1 2 {0} {0} {1} {2}".format(names.index(name) + 2, a + 1, b + 1))
    text = [
        "$MeshFormat",
        "2.2 0 8",
        "$EndMeshFormat",
        "$PhysicalNames",
        str(len(names) + 1),
        '2 1 "all"',
    ]
    text += [
        *(f'1 {k} "{name}"' for k, name in enumerate(names, 2)),
        "$EndPhysicalNames",
        "$Nodes",
        str(len(nodes)),
    ]
    text += [
        *(f"{k} {x!r} {y!r} 0" for k, (x, y) in enumerate(nodes.tolist(), 1)),
        "$EndNodes",
        "$Elements",
    ]
    text += [
        str(len(elements)),
        *(f"{k} {element}" for k, element in enumerate(elements, 1)),
        "$EndElements",
    ]
    file.write_text("\n".join(text) + "\n", encoding="utf-8")
    return file


def sheet(file: Path) -> Path:
    """A strip along x with the ends left and right."""
    n = CELLS + 1
    nodes = np.array([(x, y) for y in (0.0, WIDTH) for x in np.linspace(0, 1, n)])
    cells = list[tuple[int, int, int]]()
    for p in range(CELLS):
        q, r, s = p + 1, n + p + 1, n + p
        cells += [(p, q, s), (q, r, s)] if p % 2 else [(p, q, r), (p, r, s)]
    return mesh(
        file, nodes, cells, lambda at: {0.0: "left", 1.0: "right"}.get(float(at[0]), "sides")
    )


def disc(file: Path) -> Path:
    """A disc of rings of cells, whose rim has the parts left and right."""
    angles = [2 * np.pi * np.arange(6 * k) / (6 * k) for k in range(1, RINGS + 1)]
    rings = [
        RADIUS * k / RINGS * np.stack([np.cos(a), np.sin(a)], axis=1)
        for k, a in enumerate(angles, 1)
    ]
    nodes = np.concatenate([np.zeros((1, 2)), *rings])
    cells = scipy.spatial.Delaunay(
        nodes + 1e-6 * np.stack([nodes[:, 1] ** 2, nodes[:, 0] ** 2], axis=1)
    ).simplices
    x = 0.75 * RADIUS
    return mesh(
        file,
        nodes,
        cells.tolist(),
        lambda at: "left" if at[0] < -x else "right" if at[0] > x else "sides",
    )


def motion(seed: int) -> dict[str, Any]:
    """The right end is turned over by about half a turn, and pressed on the rest; a disc is also
    twisted.
    """
    rng, is_sheet = np.random.default_rng(seed), seed < SHEETS
    tilt, far = (0.15, 0.1) if is_sheet else (0.5, 0.15)
    axis = np.array([0.0, -1.0, 0.0]) + rng.uniform(-tilt, tilt, 3) * [1, 0, 1]
    point = (
        [rng.uniform(0.6, 0.75), WIDTH / 2, 0.0]
        if is_sheet
        else [rng.uniform(0.1, 0.2) * RADIUS, 0.0, 0.0]
    )
    turn = {
        "axis": axis.tolist(),
        "point": [float(x) for x in point],
        "angle": float(rng.uniform(180, 300 if is_sheet else 240)),
    }
    moved = [
        0.0,
        float(rng.uniform(-far, far)),
        float(h * (rng.uniform(-8, -2) if is_sheet else rng.uniform(-3, 0))),
    ]
    return {"supports": ["right"], "rotation": turn, "translation": moved}


def case(file: Path, seed: int) -> Case:
    """A push."""
    surface = sheet(file) if seed < SHEETS else disc(file)
    shell = {
        "geometry": "mesh",
        "file": str(surface),
        "radius": 1,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    }
    return Case.model_validate(
        {
            "shell": shell,
            "boundary": {"left": "clamped", "right": "clamped"},
            "contact": [["shell", "shell"]],
            "mesh": {"degree": 3},
            "loading": {
                "kind": "edge",
                "control": "load",
                "points": 12,
                "factor": 1,
                "moves": [motion(seed)],
            },
        }
    )


def push(folder: Path, seed: int, seen: Callable[[float], object] = lambda factor: None) -> Push:
    """One push; `seen` gets its progress."""
    begun, scene = time.process_time(), Scene(case(folder / "shell.msh", seed))
    points, touching, intersections, least, factor, said = 0, 0, 0, np.inf, 0.0, ""
    try:
        for record in follow(scene):
            state = record.point.state
            now = Surface.of(scene, scene.model.system.with_ghosts(state.u, state.mu))
            found, distance = looked_at(now, Surface.of(scene))
            intersections, least = intersections + found, min(least, distance)
            touching += scene.observe(state)["contact_force"] > 0
            points, factor = points + 1, state.mu["motion"]
            seen(factor)
    except Stopped as e:
        said = str(e)
    why = "target" if not said else "fold" if said.startswith(FOLD) else "failed"
    gap = least / h - 1 if np.isfinite(least) else np.nan
    took, kind = time.process_time() - begun, "sheet" if seed < SHEETS else "disc"
    return Push(seed, kind, factor, why, points, touching, gap, intersections, took, said)


def read(table: Path) -> list[Push]:
    """The pushes that a table has."""
    if not table.exists():
        return []
    with table.open(encoding="utf-8") as file:
        return [
            Push(**{each.name: each.type(row[each.name]) for each in fields(Push)})
            for row in csv.DictReader(file)
        ]  # type: ignore[operator]


def pushes(seeds: Sequence[int], table: Path) -> Iterator[Push]:
    """The pushes of some seeds that a table does not have, which they are added to."""
    done = {each.push for each in read(table)}
    for seed in (each for each in seeds if each not in done):
        with TemporaryDirectory() as folder:
            pushed = push(Path(folder), seed, partial(print, f"\r{seed}:", end="", flush=True))
        new = not table.exists()
        with table.open("a", encoding="utf-8", newline="") as file:
            rows = csv.writer(file)
            if new:
                rows.writerow(each.name for each in fields(Push))
            rows.writerow(asdict(pushed).values())
        yield pushed


def counts(done: Sequence[Push]) -> Iterator[str]:
    """A table of Markdown: a row for each kind."""
    yield (
        "| | pushes | target | fold | failed | points | touching | smallest gap | "
        "intersections | CPU s |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |"
    for kind in ("sheet", "disc"):
        of = [each for each in done if each.kind == kind]
        why = [sum(each.why == reason for each in of) for reason in ("target", "fold", "failed")]
        sums = [sum(each.points for each in of), sum(each.touching for each in of)]
        gap = f"{np.nanmin([each.gap for each in of] or [np.nan]):.3f} h"
        numbers = [
            len(of),
            *why,
            *sums,
            gap,
            sum(each.intersections for each in of),
            round(sum(each.seconds for each in of)),
        ]
        yield f"| {kind} | " + " | ".join(map(str, numbers)) + " |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pushes", type=int, default=200)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", type=int, nargs="*", help="these pushes alone")
    parser.add_argument("--table", type=Path, default=Path("pushes.csv"))
    given = parser.parse_args()
    for pushed in pushes(given.only or range(given.first, given.first + given.pushes), given.table):
        print("\r", *asdict(pushed).values(), flush=True)
    print(*counts(read(given.table)), sep="\n")
