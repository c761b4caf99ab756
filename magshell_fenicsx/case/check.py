"""What `magshell check` prints of a case."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.msh import MeshFile
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.parts.pressure.openings import no_potential, ring_openings
from magshell_fenicsx.problem.columns import sizes_of
from magshell_fenicsx.problem.formulas import cells_of_patch, unshown, written
from magshell_fenicsx.problem.limits import refuse_beyond_memory
from magshell_fenicsx.problem.names import open_edges
from magshell_fenicsx.problem.problem import Problem, meridian_vertices
from magshell_fenicsx.problem.sizes import degree_of
from magshell_fenicsx.shape.sections import FLAT
from magshell_fenicsx.simulate.overlap import refuse_overlap


def describe(case: Case, problem: Problem | None = None) -> str:
    """What `magshell check` prints: dimensionless numbers, what is built, what is left out.

    Parameters
    ----------
    problem
        That of the case, if it is made already.

    Raises
    ------
    CaseError
        If the case cannot be built, or nothing is held.
    """
    try:
        return _described(case, problem or make_problem(case))
    except (CaseError, MeshError) as e:
        raise CaseError(case.placed(str(e))) from None


def _described(case: Case, problem: Problem) -> str:
    too_large = None if case.mesh.tolerance else refuse_beyond_memory(problem)
    unsupported = all(
        condition in ("free", "symmetry") for condition in problem.conditions.values()
    )
    springs_may_hold = bool(problem.loads.own)  # a run asks its tangent
    if unsupported and not (problem.at_rest or problem.moves_freely or springs_may_hold):
        raise CaseError(
            "boundary: nothing is held: clamp an edge or a patch, or hold points, for instance"
            + problem.support_hint
        )
    numbers = {
        "R/h": 1 / problem.material.h,
        "nu": problem.material.nu,
        "p_c/E": problem.material.classical_pressure,
        "lambda_m": case.lambda_m,
        "Lambda_m = lambda_m R/h": case.lambda_m / problem.material.h,
    }
    flat = (
        case.context.shell.geometry in FLAT and not problem.loads.pressure
    )  # p_c is of spheres, and the unit of pressures
    if flat:
        del numbers["p_c/E"]
    lines = [f"{name} = {value:.6g}" for name, value in numbers.items()]
    lines += _in_units(case, without="p_c" if flat else "")
    lines += case.several.told if case.several else []
    lines += [line for part in case.context.abilities for line in part.numbers(case.context)]
    patch = None
    if case.mesh.tolerance is None:
        patch = None if problem.axisymmetric else problem.triangulated()
        cells, unknowns = _count(problem, patch)
        refuse_overlap(problem, cells)
        lines.append(
            f"mesh: {cells} cells of degree {degree_of(problem.context)}, {unknowns} unknowns"
        )
        if patch and not problem.body and (sliver := problem.flat_triangle(patch)):
            lines.append(f"mesh: may be unstable: {sliver}")
        if patch and isinstance(problem.shape, MeshFile):
            lines += _surface(patch)
    else:
        lines.append(
            f"mesh: found by the run, for a relative error of its result below {case.mesh.tolerance:g}"
        )
    left_out = list(problem.left_out)
    if problem.loads.pressure and (open_at := _open(problem, patch)):
        left_out.append(no_potential(open_at))
    if case.ensemble:
        left_out.append("ensemble: random values (magshell ensemble alone draws them)")
    if case.design:
        left_out.append("design: what varies (magshell design alone varies it)")
    if case.identify:
        left_out.append(
            "identify: numbers that are looked for (magshell identify alone varies them)"
        )
    left_out = left_out or ["nothing"]
    lines += [
        "built:",
        *(f"  {item}" for item in problem.included),
        "left out:",
        *(f"  {item}" for item in left_out),
    ]
    missed: list[str] = []
    if patch and (formulas := written(problem.context)):
        missed = unshown(
            formulas,
            cells_of_patch(patch, degree_of(problem.context)),
            problem.azimuth,
            problem.material.h,
        )
    lines += [f"warning: {said}" for said in (*problem.warnings, too_large, *missed) if said]
    return "\n".join(lines)


def _in_units(case: Case, without: str) -> list[str]:
    """The sizes of a case with units, but for one scale."""
    sizes = sizes_of(case.context)
    named = {
        "h": ("h", "mm"),
        "p_c": ("p_c", "Pa"),
        "2πD/R": ("2 pi D/R", "N"),
        "λ_m": ("applied field", sizes.field),
    }
    factor = {"λ_m": case.lambda_m}
    shown = {
        scale: words for scale, words in named.items() if scale in sizes.of and scale != without
    }
    return [
        f"{name} = {sizes.of[scale] * factor.get(scale, 1.0):.6g} {unit}"
        for scale, (name, unit) in shown.items()
    ]


def _open(problem: Problem, patch: PatchMesh | None) -> tuple[str, ...]:
    """The edges at which a live pressure has no potential."""
    span = problem.meridian
    if span is None:
        return open_edges(
            patch or problem.triangulated(), problem.conditions, problem.loads.pressed
        )
    return ring_openings(span.ends(), problem.conditions, problem.loads.pressed)[1]


def _surface(patch: PatchMesh) -> list[str]:
    """What a mesh file holds, for its author to see that it was read as it was meant."""
    places = patch.embedding(patch.nodes)
    a, b, c = places[patch.cells[0, :3]]
    normal = np.cross(b - a, c - a)
    extent, at, n = np.ptp(places, axis=0), (a + b + c) / 3, normal / np.linalg.norm(normal)
    return [
        f"extent over the radius: {' x '.join(f'{x:.4g}' for x in extent)}",
        f"edges: {', '.join(patch.edges) or 'none'}; patches: {', '.join(patch.patches) or 'none'}",
        f"outside: the normal at {_told(at)}, over the radius, is {_told(n)}",
    ]


def _told(vector: NDArray[np.float64]) -> str:
    return f"({', '.join(f'{x + 0.0:.4g}' for x in np.round(vector, 9))})"


def _count(problem: Problem, patch: PatchMesh | None) -> tuple[int, int]:
    """Cells and unknowns of the mesh, or of the meridian."""
    k = degree_of(problem.context)
    if patch is None:
        assert problem.meridian
        along = problem.meridian
        pieces = max(len(along.pieces) - sum(one == other for one, other in along.joints), 1)
        count = len(meridian_vertices(problem)) - pieces
        return count, 2 * (k * count + pieces)
    cells, corners = patch.corners, len(np.unique(patch.corners))
    sides = len(np.unique(np.sort(cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0))
    if problem.body:  # three hexahedra a layer above each triangle
        count = len(problem.body.layers) - 1
        return 3 * len(cells) * count, 3 * (2 * count + 1) * (corners + 3 * sides + 7 * len(cells))
    return len(cells), 3 * (corners + (k - 1) * sides + (k - 1) * (k - 2) // 2 * len(cells))
