"""Mesh files of flat sheets that are not connected."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sheet:
    """A rectangle in triangles, whose corner is at `origin` and whose sides are the vectors; edges
    NAME_1 to NAME_4.
    """

    name: str
    origin: tuple[float, float, float]
    along: tuple[float, float, float]
    across: tuple[float, float, float]
    parts: tuple[int, int]


def write(file: Path, sheets: Sequence[Sheet], *, joined: bool = False) -> Path:
    """A mesh file of gmsh's version 2 with a patch and four edges for each sheet; `joined`: nodes
    that meet are one.
    """
    nodes, elements, names, kept = list[Array](), list[str](), list[str](), dict[int, int]()
    for k, sheet in enumerate(sheets):
        first, (m, n), start = len(nodes) + 1, sheet.parts, np.array(sheet.origin)
        a, b = np.array(sheet.along) / m, np.array(sheet.across) / n
        nodes += [start + i * a + j * b for j in range(n + 1) for i in range(m + 1)]
        for number in range(first, len(nodes) + 1):
            apart = np.linalg.norm(np.array(nodes) - nodes[number - 1], axis=1)
            kept[number] = 1 + int(apart.round(9).argmin()) if joined else number

        def at(i: int, j: int, first: int = first, m: int = m) -> int:
            return kept[first + j * (m + 1) + i]

        surface = 10 * k + 1
        names.append(f'2 {surface} "{sheet.name}"')
        for i in range(m):
            for j in range(n):
                p, q, r, s = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
                corners = ((p, q, r), (p, r, s)) if (i + j) % 2 else ((p, q, s), (q, r, s))
                elements += [f"2 2 {surface} {surface} {x} {y} {z}" for x, y, z in corners]
        sides = (
            [(at(i, 0), at(i + 1, 0)) for i in range(m)],
            [(at(m, j), at(m, j + 1)) for j in range(n)],
            [(at(i, n), at(i + 1, n)) for i in range(m)],
            [(at(0, j), at(0, j + 1)) for j in range(n)],
        )
        for side, lines in enumerate(sides, 1):
            names.append(f'1 {surface + side} "{sheet.name}_{side}"')
            elements += [f"1 2 {surface + side} {surface + side} {x} {y}" for x, y in lines]
    text = [
        "$MeshFormat",
        "2.2 0 8",
        "$EndMeshFormat",
        "$PhysicalNames",
        str(len(names)),
        *names,
        "$EndPhysicalNames",
    ]
    text += [
        "$Nodes",
        str(len(nodes)),
        *(f"{i} {x} {y} {z}" for i, (x, y, z) in enumerate(nodes, 1)),
        "$EndNodes",
    ]
    text += [
        "$Elements",
        str(len(elements)),
        *(f"{i} {e}" for i, e in enumerate(elements, 1)),
        "$EndElements",
    ]
    file.write_text("\n".join(text) + "\n", encoding="utf-8")
    return file
