"""The hyperboloid of Lee and Bathe: energies against those of its meridian, for thin and thinner shells.

`python3 -m benchmarks.hyperboloid` (with PYTHONPATH=cases) writes docs/hyperboloid/README.md.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import ufl
from dolfinx import fem

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.axisymmetric import jets
from magshell_fenicsx.models.axisymmetric.meridian import make_meridian
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.plan.planner import make_plan, meridian_vertices
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.scene import Scene

CASE = Path(__file__).parent / "hyperboloid.yaml"
OUT = CASE.parents[2] / "docs" / "hyperboloid" / "README.md"
Edge = Literal["clamped", "free"]
POWER = {"clamped": 1, "free": 3}  # of h in the energy: a membrane, bending
INTERVALS = 16
M = 2  # waves of the load around the axis
TEXT = """# A hyperboloid, thinner and thinner

Lee and Bathe's hyperboloid of revolution, r² = 1 + z² (-1 ≤ z ≤ 1, ν = 1/3), under a dead pressure p cos 2θ, in the
linear regime. With clamped edges the membrane carries the load, with free edges bending does: the strain energy U of
the whole shell is of the order p²/(E h) and p²/(E h³). `python3 -m benchmarks.hyperboloid` writes this page.

The **reference** is another discretisation: the second variation of waves cos 2θ on the meridian
(`models/axisymmetric/waves.py`), on intervals graded to √h, with free edges on 32 equal ones; **its error** is the
difference from half as many. **error** is the relative error of U on uniform triangles (an eighth of the shell,
degree 4), **order** that of the last two meshes in the size of the elements, where it is above the reference's error.

- Both energies tend to a number as h falls, as the theory has it.
- Free edges: on a fixed mesh the error grows by about 20 to 30 with each decade of R/h. So the elements do lock on
  coarse meshes, by 4 % on the coarsest at R/h = 10 000. It falls with the sixth power of the size to the next mesh;
  with 0.1 it is below the error of the reference.
- Clamped edges: uniform meshes do not resolve the layers of the width √h, 0.01 at R/h = 10 000. The error falls slowly
  there; it is below 2 % on all of them.

"""


def reference(edge: Edge, R_over_h: float, refinement: float = 1.0) -> float:
    """U E h^k/p^2 of the whole shell from the waves m = 2 of the meridian, with k of `POWER`."""
    h = 1 / R_over_h
    settings = ["shell.azimuth=null", "boundary={bottom: symmetry, top: clamped}", f"shell.thickness={h}"]
    load = "loading.loads=[{over: all, pressure: 1.0}]"
    case = Case.load(CASE, [*settings, load])
    plan = make_plan(case)
    span, length = plan.meridian, case.shell.reference
    assert span
    vertices = meridian_vertices(plan, refinement)
    if edge == "free":  # no strong layers, and bending is so soft that rounding grows with the number of intervals
        vertices = np.linspace(0.0, span.length, round(INTERVALS * refinement) + 1)
    meridian = make_meridian(span.embedding, vertices, span.names, {}, span.curvature)
    conditions = {**plan.conditions, "top": edge}
    model = MeridianModel(meridian, plan.material, 4, conditions, plan.loads)
    waves, factory = model.excluded_modes.waves, model.factory
    v = ufl.TestFunction(waves.V)
    along = jets.wave(v, fem.Constant(meridian.mesh, float(M)))[0].r
    form = np.pi * factory.area()(-ufl.dot(kin.normal(factory.j0), along))  # of the pressure E h/R
    f = fem.assemble_vector(fem.form(form)).array.copy()
    for support in waves.held(M):
        f[support.dof_indices()[0]] = 0
    factors = waves.factor_at(State(model.zero(), {"load": 0.0}), M)
    energy = float(f @ factors.solve(f)) / 2  # over E h R^2 at p = E h/R; half of the shell
    return 2 * energy * length**4 / h * h ** POWER[edge]


def energy(edge: Edge, R_over_h: float, size: float, *settings: str) -> float:
    """The same from triangles."""
    h = 1 / R_over_h
    p = 1e-4 * h ** (POWER[edge] + 1)
    more = [f"shell.thickness={h}", f"boundary.top={edge}", f"mesh.size={size}"]
    more.append(f'loading.loads=[{{over: all, pressure: "{p}*cos(2*arctan2(y, x))"}}]')
    scene = Scene(Case.load(CASE, [*more, *settings]))
    *_, last = follow(scene)
    found = scene.observe(last.point.state)
    whole = 8 * h * scene.plan.length**2 * (found["stretching"] + found["bending"])
    return float(whole * h ** POWER[edge] / p**2)


def rows(edge: Edge, thin: Sequence[float], sizes: Sequence[float]) -> list[str]:
    """Lines of the table of one kind of edges."""
    lines = []
    for R_over_h in thin:
        exact, finer = reference(edge, R_over_h), reference(edge, R_over_h, 2.0)
        errors = [abs(energy(edge, R_over_h, size) / finer - 1) for size in sizes]
        slope = np.log(errors[-2] / errors[-1]) / np.log(sizes[-2] / sizes[-1])
        order = f"{slope:.1f}" if errors[-1] > 2 * abs(exact / finer - 1) else "-"
        cells = [f"{R_over_h:g}", f"{finer:.9g}", f"{abs(exact / finer - 1):.0e}", *(f"{e:.1e}" for e in errors)]
        lines.append(f"| {' | '.join([*cells, order])} |")
        print(edge, lines[-1], flush=True)
    return lines


def main() -> None:
    """Write the page."""
    thin, sizes, text = (10.0, 100.0, 1000.0, 10000.0), (0.4, 0.2, 0.1), TEXT
    for edge, unit in (("clamped", "p²/(E h)"), ("free", "p²/(E h³)")):
        head = [f"U over {unit}", "its error", *(f"error, size {size:g}" for size in sizes), "order"]
        text += f"## {edge.capitalize()} edges\n\n| R/h | {' | '.join(head)} |\n{'| --- ' * (len(head) + 1)}|\n"
        text += "\n".join(rows(edge, thin, sizes)) + "\n\n"  # type: ignore[arg-type]
    OUT.parent.mkdir(exist_ok=True)
    OUT.write_text(text.rstrip() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
