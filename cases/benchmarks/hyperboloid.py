"""The hyperboloid of Lee and Bathe: energies against those of its meridian, for thin and thinner
shells.

`python3 -m benchmarks.hyperboloid` (with PYTHONPATH=cases) writes docs/hyperboloid/README.md.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from pathlib import Path
from typing import Literal

import numpy as np
import ufl
from dolfinx import fem

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.grading import Grading, LineFeature
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.models import domains
from magshell_fenicsx.models.axisymmetric.meridian import make_meridian
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.problem.problem import meridian_vertices
from magshell_fenicsx.public import Scene
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.follow import follow

CASE = Path(__file__).parent / "hyperboloid.yaml"
OUT = CASE.parents[2] / "docs" / "hyperboloid" / "README.md"
Edge = Literal["clamped", "free"]
POWER = {"clamped": 1, "free": 3}  # of h in the energy: a membrane, bending
INTERVALS = 16
LAYER, GROWTH = 4.0, 2.0  # over the size: of the cells in a layer over √h, and of their growth
M = 2  # waves of the load around the axis
TEXT = """# A hyperboloid, thinner and thinner

Lee and Bathe's hyperboloid of revolution, r² = 1 + z² (-1 ≤ z ≤ 1, ν = 1/3), \
under a dead pressure p cos 2θ, in the
linear regime. With clamped edges the membrane carries the load, with free edges bending does: \
the strain energy U of
the whole shell is of the order p²/(E h) and p²/(E h³). \
`python3 -m benchmarks.hyperboloid` writes this page.

The **reference** is another discretisation: the second variation of waves cos 2θ on the meridian
(`shells/waves.py`), on intervals graded to √h, with free edges on 32 equal ones; \
**its error** is the
difference from half as many. **error** is the relative error of U on triangles \
(an eighth of the shell, degree 4),
**order** that of the last two meshes in the size of the elements, \
where it is above the reference's error.

- Both energies tend to a number as h falls, as the theory has it.
- Clamped edges have layers of the width √h. On meshes with cells of 4 √h times the size there, \
which grow away from
  the edge, the error is the same for thick and thin shells, with the order 6 to 7: no locking. \
Uniform meshes do not
  resolve the layer at R/h = 10 000, 0.01 wide; the error is below 2 %, but the order is lost.
- Free edges: the shell bends without stretching, and the element, which has displacements alone, \
locks on coarse
  meshes: on one mesh the error grows with R/h. It is no layer that is missed, \
as the last table shows: with equally
  many unknowns the error falls with the degree, for thin shells most. \
Degree 2 is useless for thin shells, 3 has 4 %
  on the finer mesh at R/h = 10 000, 4 has 6e-4 and 5 has 5e-6. \
Locking becomes weak with the degree, and disappears
  at none: **ratio**, the error at R/h = 10 000 over that at 100, \
is still 270 at degree 5 (27 on the finer mesh, where
  the reference's error counts).

"""


def reference(edge: Edge, R_over_h: float, refinement: float = 1.0) -> float:
    """U E h^k/p^2 of the whole shell from the waves m = 2 of the meridian, with k of `POWER`."""
    h = 1 / R_over_h
    settings = [
        "shell.azimuth=null",
        "boundary={bottom: symmetry, top: clamped}",
        f"shell.thickness={h}",
    ]
    load = "loading.loads=[{over: all, pressure: 1.0}]"
    case = Case.load(CASE, [*settings, load, f"mesh={{refinement: {refinement}}}"])
    problem = make_problem(case)
    span, length = problem.meridian, case.shell.reference
    assert span
    vertices = meridian_vertices(problem)
    if (
        edge == "free"
    ):  # no strong layers, and bending is so soft that rounding grows with the number of intervals
        vertices = np.linspace(0.0, span.length, round(INTERVALS * refinement) + 1)
    meridian = make_meridian(span.embedding, vertices, span.names, {}, span.curvature)
    conditions = {**problem.conditions, "top": edge}
    model = MeridianModel(meridian, problem.material, 4, conditions, problem.loads)
    waves, domain = model.waves, model.factory.domain
    v = ufl.TestFunction(waves.V)
    along = domains.wave_jets(v, fem.Constant(meridian.mesh, float(M)))[0].r
    form = np.pi * domain.over_area()(
        -ufl.dot(kin.normal(domain.j0), along)
    )  # of the pressure E h/R
    f = fem.assemble_vector(fem.form(form)).array.copy()
    for support in waves.constraints(M):
        f[support.dof_indices()[0]] = 0
    factors = waves.factor_at(State(model.zero(), {"load": 0.0}), M)
    energy = float(f @ factors.solve(f)) / 2  # over E h R^2 at p = E h/R; half of the shell
    return 2 * energy * length**4 / h * h ** POWER[edge]


def energy(edge: Edge, R_over_h: float, size: float, *settings: str, graded: bool = False) -> float:
    """The same from triangles, as small across the layer at the edge as its width √h asks for if
    they are graded.
    """
    h = 1 / R_over_h
    p = 1e-4 * h ** (POWER[edge] + 1)
    more = [f"shell.thickness={h}", f"boundary.top={edge}", f"mesh.size={size}"]
    more.append(f'loading.loads=[{{over: all, pressure: "{p}*cos(2*arctan2(y, x))"}}]')
    case = Case.load(CASE, [*more, *settings])
    problem = make_problem(case)
    if graded:
        grid = problem.shape
        assert isinstance(grid, Grid)
        place = (grid.low, grid.high)[grid.sides.index("top") % 2][1]
        layer = LineFeature(1, place, LAYER * size * sqrt(h), GROWTH * size)
        problem = replace(problem, shape=replace(grid, size=Grading([layer], size).line_spacing))
    scene = Scene(problem)
    *_, last = follow(scene)
    found = scene.observe(last.point.state)
    whole = 8 * h * scene.problem.length**2 * (found["stretching"] + found["bending"])
    return float(whole * h ** POWER[edge] / p**2)


def rows(edge: Edge, thin: Sequence[float], sizes: Sequence[float], *, graded: bool) -> list[str]:
    """Lines of the table of one kind of edges."""
    lines = []
    for R_over_h in thin:
        exact, finer = reference(edge, R_over_h), reference(edge, R_over_h, 2.0)
        errors = [abs(energy(edge, R_over_h, size, graded=graded) / finer - 1) for size in sizes]
        slope = np.log(errors[-2] / errors[-1]) / np.log(sizes[-2] / sizes[-1])
        order = f"{slope:.1f}" if errors[-1] > 2 * abs(exact / finer - 1) else "-"
        cells = [
            f"{R_over_h:g}",
            f"{finer:.9g}",
            f"{abs(exact / finer - 1):.0e}",
            *(f"{e:.1e}" for e in errors),
        ]
        lines.append(f"| {' | '.join([*cells, order])} |")
        print(edge, lines[-1], flush=True)
    return lines


def degrees(thin: Sequence[float]) -> list[str]:
    """Lines of the table of degrees with about equally many unknowns."""
    lines = []
    for degree in (2, 3, 4, 5):
        for size in (0.1 * degree, 0.05 * degree):
            errors = []
            for R_over_h in thin:
                exact = reference("free", R_over_h, 2.0)
                errors.append(
                    abs(energy("free", R_over_h, size, f"mesh.degree={degree}") / exact - 1)
                )
            cells = [
                f"{degree}",
                f"{size:g}",
                *(f"{e:.1e}" for e in errors),
                f"{errors[-1] / errors[0]:.2g}",
            ]
            lines.append(f"| {' | '.join(cells)} |")
            print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Write the page."""
    thin, sizes, text = (10.0, 100.0, 1000.0, 10000.0), (0.4, 0.2, 0.1), TEXT
    tables = (
        ("clamped", "p²/(E h)", True),
        ("clamped", "p²/(E h)", False),
        ("free", "p²/(E h³)", False),
    )
    for edge, unit, graded in tables:
        head = [
            f"U over {unit}",
            "its error",
            *(f"error, size {size:g}" for size in sizes),
            "order",
        ]
        mesh = {"clamped": ", graded meshes" if graded else ", uniform meshes", "free": ""}[edge]
        text += (
            f"## {edge.capitalize()} edges{mesh}\n\n| R/h | {' | '.join(head)} |\n"
            f"{'| --- ' * (len(head) + 1)}|\n"
        )
        text += "\n".join(rows(edge, thin, sizes, graded=graded)) + "\n\n"  # type: ignore[arg-type]
    names = (
        "| degree | size | "
        + " | ".join(f"error, R/h = {R_over_h:g}" for R_over_h in thin[1::2])
        + " | ratio |"
    )
    text += f"## Free edges, degrees with equally many unknowns\n\n{names}\n{'| --- ' * 5}|\n"
    text += "\n".join(degrees(thin[1::2])) + "\n"
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_text(text.rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
