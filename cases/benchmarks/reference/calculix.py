"""CalculiX input for an octant of a cylinder: one layer of C3D20R, the corner A moved radially in
steps.

python3 calculix.py pinched 32 32 36 > pinched.inp && ccx pinched
python3 calculix.py pinched --read pinched.dat
"""

import argparse
import re
from itertools import pairwise, product
from math import cos, pi, sin
from pathlib import Path

# radius, half length, thickness, Young's modulus, Poisson's ratio, on a diaphragm, last
# displacement of A, load
PROBLEMS = {
    "pinched": (100.0, 100.0, 1.0, 30e3, 0.3, True, -84.0, 12e3),
    "pullout": (4.953, 5.175, 0.094, 10.5e6, 0.3125, False, 2.76, 40e3),
}


def numbered_nodes(n: int, m: int) -> dict[tuple[int, int, int], int]:
    """Return the number of each node (i, j, k) of n times m cells with 20 nodes."""
    number: dict[tuple[int, int, int], int] = {}
    for a, b in product(range(n), range(m)):
        for i, j in product(range(2 * a, 2 * a + 3), range(2 * b, 2 * b + 3)):
            for k in {0: (0, 1, 2), 1: (0, 2)}.get(i % 2 + j % 2, ()):
                number.setdefault((i, j, k), len(number) + 1)
    return number


def written(problem: str, n: int, m: int, steps: int) -> str:
    """The input; nodes are at half steps (i, j) around and along, k = 0, 1, 2 through the
    thickness.
    """
    R, L, h, E, nu, held, end, _ = PROBLEMS[problem]
    number = numbered_nodes(n, m)
    out = ["*NODE"]
    for (i, j, k), node in number.items():
        r, t = R + h * (k - 1) / 2, pi / 2 * i / (2 * n)
        out.append(f"{node}, {r * cos(t):.12g}, {r * sin(t):.12g}, {L * j / (2 * m):.12g}")
    out.append("*ELEMENT, TYPE=C3D20R, ELSET=SHELL")
    for cell in range(n * m):
        i, j = 2 * (cell // m), 2 * (cell % m)
        ring = [(i + 2, j), (i + 2, j + 2), (i, j + 2), (i, j)]
        mids = [((p[0] + q[0]) // 2, (p[1] + q[1]) // 2) for p, q in pairwise([*ring, ring[0]])]
        nodes = [
            number[*x, k]
            for part, k in ((ring, 0), (ring, 2), (mids, 0), (mids, 2), (ring, 1))
            for x in part
        ]
        first, second = (", ".join(map(str, part)) for part in (nodes[:10], nodes[10:]))
        out += [f"{cell + 1}, {first},", second]
    corners = {"A": (0, 0), "B": (2 * n, 0), "C": (2 * n, 2 * m)}
    for name, x in corners.items():
        out += [f"*NSET, NSET={name}", ", ".join(str(number[*x, k]) for k in range(3))]
    out.append("*BOUNDARY")
    for dof, axis, where in ((1, 0, 2 * n), (2, 0, 0), (3, 1, 0)):  # planes of symmetry
        out += [f"{node}, {dof}" for key, node in number.items() if key[axis] == where]
    for i in range(2 * n + 1) if held else ():  # the mid-surface is held, its director is free
        for dof in {0: (1,), 2 * n: (2,)}.get(i, (1, 2)):
            out += [
                "*EQUATION",
                "2",
                f"{number[i, 2 * m, 2]}, {dof}, 1, {number[i, 2 * m, 0]}, {dof}, 1",
            ]
    out += [
        "*MATERIAL, NAME=M",
        "*ELASTIC",
        f"{E}, {nu}",
        "*SOLID SECTION, ELSET=SHELL, MATERIAL=M",
    ]
    out += [
        "*STEP, NLGEOM, INC=2000",
        "*STATIC",
        f"{1 / steps}, 1, 1e-6, {1 / steps}",
        "*BOUNDARY",
        f"A, 1, 1, {end}",
    ]
    for name in corners:
        out += [f"*NODE PRINT, NSET={name}", "U"]
    return "\n".join([*out, "*NODE PRINT, NSET=A, TOTALS=ONLY", "RF", "*END STEP", ""])


def read(problem: str, file: Path) -> str:
    """Load factor, u_x of A, u_y of B and of C from a .dat file, as CSV; means of the two faces."""
    rows, means = ["load_factor,A_ux,B_uy,C_uy"], {}
    for block in re.split(r"\n (?=displacements|total force)", file.read_text(encoding="utf-8"))[
        1:
    ]:
        head, *lines = block.strip().splitlines()
        values = [[float(x) for x in line.split()] for line in lines if line.strip()]
        if head.startswith("total"):
            factor = 4 * abs(values[0][0]) / PROBLEMS[problem][-1]
            rows.append(f"{factor:.6g},{means['A'][0]:.6g},{means['B'][1]:.6g},{means['C'][1]:.6g}")
        else:
            name = head.split(" for set ")[1][0]
            means[name] = [(a + b) / 2 for a, b in zip(values[0][1:], values[-1][1:], strict=True)]
    return "\n".join(rows) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("problem", choices=PROBLEMS)
    parser.add_argument(
        "mesh", type=int, nargs="*", metavar="N", help="elements around, along; steps"
    )
    parser.add_argument("--read", type=Path)
    given = parser.parse_args()
    print(
        read(given.problem, given.read) if given.read else written(given.problem, *given.mesh),
        end="",
    )


if __name__ == "__main__":
    main()
