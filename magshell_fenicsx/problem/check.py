"""What `magshell check` prints of a plan."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.msh import MeshFile
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.parts.magnetism.sources.field import placed
from magshell_fenicsx.parts.pressure.openings import no_potential, ring_openings
from magshell_fenicsx.problem.body import layers
from magshell_fenicsx.problem.columns import sizes_of
from magshell_fenicsx.problem.formulas import cells_of_patch, unshown, written
from magshell_fenicsx.problem.limits import refuse_beyond_memory
from magshell_fenicsx.problem.names import open_edges
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.problem.problem import Plan, meridian_vertices
from magshell_fenicsx.shape.outline import outline


def describe(case: Case) -> str:
    """What `magshell check` prints: dimensionless numbers, what is built, what is left out.

    Raises
    ------
    CaseError
        If the case cannot be built, or nothing is held.
    """
    try:
        return _described(case)
    except (CaseError, MeshError) as e:
        raise CaseError(case.placed(str(e))) from None


def _described(case: Case) -> str:
    plan = make_plan(case)
    too_large = None if case.mesh.tolerance else refuse_beyond_memory(case, plan)
    if all(condition in ("free", "symmetry") for condition in plan.conditions.values()):
        raise CaseError("boundary: nothing is held: clamp an edge or a patch, or hold points, for instance")
    numbers = {
        "R/h": 1 / plan.material.h,
        "nu": plan.material.nu,
        "p_c/E": plan.material.classical_pressure,
        "lambda_m": case.lambda_m,
        "Lambda_m = lambda_m R/h": case.lambda_m / plan.material.h,
    }
    lines = [f"{name} = {value:.6g}" for name, value in numbers.items()]
    lines += [*_in_units(case), *_of_sources(case)]
    patch = None
    if case.mesh.tolerance is None:
        patch = None if plan.axisymmetric else plan.triangulated()
        cells, unknowns = _count(case, plan, patch)
        lines.append(f"mesh: {cells} cells of degree {case.degree}, {unknowns} unknowns")
        if patch and isinstance(plan.shape, MeshFile):
            lines += _surface(patch)
    else:
        lines.append(f"mesh: found by the run, for a relative error of its result below {case.mesh.tolerance:g}")
    left_out = list(plan.left_out)
    if plan.loads.pressure and (open_at := _open(plan, patch)):
        left_out.append(no_potential(open_at))
    if case.ensemble:
        left_out.append("ensemble: random values (magshell ensemble alone draws them)")
    left_out = left_out or ["nothing"]
    lines += ["built:", *(f"  {item}" for item in plan.included), "left out:", *(f"  {item}" for item in left_out)]
    missed: list[str] = []
    if patch and (formulas := written(case)):
        missed = unshown(formulas, cells_of_patch(patch, case.degree), plan.azimuth, plan.material.h)
    lines += [f"warning: {said}" for said in (plan.warning, too_large, *missed) if said]
    return "\n".join(lines)


def _in_units(case: Case) -> list[str]:
    """The sizes of a case with units."""
    known = sizes_of(case.context)
    named = {"h": ("h", "mm"), "p_c": ("p_c", "Pa"), "2πD/R": ("2 pi D/R", "N"), "λ_m": ("applied field", known.field)}
    factor = {"λ_m": case.lambda_m}
    there = {scale: words for scale, words in named.items() if scale in known.of}
    return [f"{name} = {known.of[scale] * factor.get(scale, 1.0):.6g} {unit}" for scale, (name, unit) in there.items()]


def _of_sources(case: Case) -> list[str]:
    """How strong magnets and coils are on the shell: too weak, and a place was meant in another unit."""
    sources = placed(case.context)
    if not sources:
        return []
    assert case.magnetic
    places, unit = outline(case.shell).sample(), case.magnetic.applied.reference or 1.0
    sizes = 1e3 * abs(unit) * np.linalg.norm(np.sum([source(places)[0] for source in sources], axis=0), axis=1)
    return [f"field of the sources on the undeformed shell: {sizes.min():.4g} to {sizes.max():.4g} mT"]


def _open(plan: Plan, patch: PatchMesh | None) -> tuple[str, ...]:
    """The edges at which a live pressure has no potential."""
    span = plan.meridian
    if span is None:
        return open_edges(patch or plan.triangulated(), plan.conditions)
    places = span.sample()[[0, -1]][:, [0, 2]]
    ends = {name: np.asarray(place) for name, place in zip(span.names, places, strict=True) if name}
    return ring_openings(ends, plan.conditions)[1]


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


def _count(case: Case, plan: Plan, patch: PatchMesh | None) -> tuple[int, int]:
    """Cells and unknowns of the mesh, or of the meridian."""
    k = case.degree
    if patch is None:
        return (count := len(meridian_vertices(plan)) - 1), 2 * (k * count + 1)
    cells, corners = patch.corners, len(np.unique(patch.corners))
    sides = len(np.unique(np.sort(cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0))
    if case.model == "solid":  # three hexahedra a layer above each triangle
        count = len(layers(case.context)) - 1
        return 3 * len(cells) * count, 3 * (2 * count + 1) * (corners + 3 * sides + 7 * len(cells))
    return len(cells), 3 * (corners + (k - 1) * sides + (k - 1) * (k - 2) // 2 * len(cells))
