"""A gripper that is its own image in the planes y = 0 and x = y: a hub of 1 x 1 with four arms of 3
x 0.5.

python3 meshes/scripts/gripper_closed.py > meshes/gripper_closed.msh

Half an arm and an eighth of the hub are meshed, and turned and mirrored to eight of them.
"""

from typing import TextIO

import numpy as np

ALONG = 6  # parts of an arm
HUB, WIDE, LONG = 0.5, 0.25, 3.0  # halves of the hub and of the width, and the length


def eighth() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places (n, 2), triangles (k, 3), and which of these are of the hub."""
    x = HUB + LONG * np.arange(ALONG + 1) / ALONG
    places = [(0.0, 0.0), (HUB, HUB), *((a, b) for a in x for b in (0.0, WIDE))]
    hub = [(0, 2, 3), (0, 3, 1)]
    arm = [
        each
        for i in range(2, 2 + 2 * ALONG, 2)
        for each in ((i, i + 2, i + 1), (i + 1, i + 2, i + 3))
    ]
    return np.array(places), np.array(hub + arm), np.arange(len(hub + arm)) < len(hub)


def write(file: TextIO) -> None:
    """The mesh in gmsh's format 2.2."""
    places, triangles, of_hub = eighth()
    all_places, all_triangles, groups = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for k in range(4):
        c, s = round(np.cos(k * np.pi / 2)), round(np.sin(k * np.pi / 2))
        for sign in (1, -1):  # mirrored triangles run the other way round
            all_triangles.append(triangles[:, ::sign] + len(places) * len(all_places))
            all_places.append(places * [1, sign] @ np.array([[c, s], [-s, c]]))
            groups.append(np.where(of_hub, 1, 2))
    nodes, number = np.unique(
        np.round(np.concatenate(all_places), 9) + 0.0, axis=0, return_inverse=True
    )
    cells, group = number.reshape(-1)[np.concatenate(all_triangles)], np.concatenate(groups)
    sides = np.sort(np.concatenate([cells[:, [0, 1]], cells[:, [1, 2]], cells[:, [2, 0]]]), axis=1)
    sides, count = np.unique(sides, axis=0, return_counts=True)
    outline = sides[count == 1]
    named = [(1, 3, "outline"), (2, 1, "hub"), (2, 2, "arms")]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", str(len(named))]
    lines += [f'{dim} {number} "{name}"' for dim, number, name in named]
    lines += ["$EndPhysicalNames", "$Nodes", str(len(nodes))]
    lines += [f"{i} {x:.9g} {y:.9g} 0" for i, (x, y) in enumerate(nodes, 1)]
    lines += ["$EndNodes", "$Elements", str(len(outline) + len(cells))]
    lines += [f"{i} 1 2 3 3 {a} {b}" for i, (a, b) in enumerate(outline + 1, 1)]
    numbered = enumerate(zip(group, cells + 1, strict=True), 1 + len(outline))
    lines += [f"{i} 2 2 {g} {g} {a} {b} {c}" for i, (g, (a, b, c)) in numbered]
    file.write("\n".join([*lines, "$EndElements", ""]))


if __name__ == "__main__":
    import sys

    write(sys.stdout)
