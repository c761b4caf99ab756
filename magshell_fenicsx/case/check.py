"""Description of a case, as `magshell check` prints it.

A problem is a case that is planned but not built: loads, supports and element sizes. The patch is
its triangulation, a named patch a part of the surface. A live pressure follows the surface as it
deforms; at a moving edge it may have no potential. h, R and E are thickness, reference length and
Young's modulus, p_c is the classical buckling pressure of a sphere.
"""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.msh import MeshFile
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.parts.magnetism.fields import GROUPS, dimensionless_groups
from magshell_fenicsx.parts.magnetism.interaction import refuse_large
from magshell_fenicsx.parts.pressure.openings import no_potential, ring_openings
from magshell_fenicsx.parts.shell_sections import FLAT_GEOMETRIES
from magshell_fenicsx.parts.supports.supports import NOT_HELD
from magshell_fenicsx.problem.columns import sizes_of
from magshell_fenicsx.problem.formulas import case_formulas, cells_of_patch, unresolved_formulas
from magshell_fenicsx.problem.memory import refuse_beyond_memory
from magshell_fenicsx.problem.mesh_sizes import degree_of
from magshell_fenicsx.problem.problem import Problem, meridian_vertices
from magshell_fenicsx.problem.surface_names import open_edges
from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.simulate.overlap import refuse_overlap


def describe(case: Case, problem: Problem | None = None) -> str:
    """Return the text of `magshell check`: dimensionless numbers, what is built, what is left out.

    Parameters
    ----------
    problem
        The problem of the case, if it is made already.

    Raises
    ------
    CaseError
        If the case cannot be built, or nothing is held.
    """
    try:
        return _description(case, problem or make_problem(case))
    except (CaseError, MeshError) as e:
        raise CaseError(case.with_place(str(e))) from None


def _description(case: Case, problem: Problem) -> str:
    """Return the text of `magshell check`: numbers, mesh, contents of the model, warnings.

    Raises CaseError if nothing holds the shell or the memory is too small.
    """
    # with a tolerance for the result, the run finds the mesh: only then the memory is known
    memory_warning = None if case.mesh.tolerance else refuse_beyond_memory(problem)
    _refuse_unsupported(problem)
    lines = _number_lines(case, problem)
    patch = None  # the triangulation, if it is made here
    if case.mesh.tolerance is None:
        patch = None if problem.axisymmetric else problem.triangulated()
        lines += _mesh_lines(problem, patch)
    else:
        lines.append(
            "mesh: found by the run, for a relative error of its result below "
            f"{case.mesh.tolerance:g}"
        )
    # what the model leaves out, and sections of the case that only other commands read
    left_out = list(problem.left_out)
    edges = _edges_without_potential(problem, patch) if problem.loads.pressure else ()
    if edges:
        left_out.append(no_potential(edges))
        if case.mesh.tolerance is None:  # the tangent is skewed there, and takes more
            memory_warning = refuse_beyond_memory(problem, skewed=True)
    if case.ensemble:
        left_out.append("ensemble: random values (magshell ensemble alone draws them)")
    if case.design:
        left_out.append("design: what varies (magshell design alone varies it)")
    if case.identify:
        left_out.append(
            "identify: numbers that are looked for (magshell identify alone varies them)"
        )
    lines += ["built:", *(f"  {item}" for item in problem.included)]
    lines += ["left out:", *(f"  {item}" for item in left_out or ["nothing"])]
    unresolved: list[str] = []  # formulas with details that are narrower than the cells
    if patch and (formulas := case_formulas(problem.context)):
        cells = cells_of_patch(patch, degree_of(problem.context))
        unresolved = unresolved_formulas(formulas, cells, problem.azimuth, problem.material.h)
    warnings = (*problem.warnings, memory_warning, *unresolved)
    lines += [f"warning: {warning}" for warning in warnings if warning]
    return "\n".join(lines)


def _refuse_unsupported(problem: Problem) -> None:
    """Raise CaseError for a shell that nothing holds."""
    conditions = [*problem.conditions.values()]
    unsupported = all(condition in ("free", "symmetry", "plane") for condition in conditions)
    # each plane of symmetry stops the motion along its normal: those of a meridian have one normal
    normals = min(conditions.count("plane"), 1 if problem.axisymmetric else 3)
    # springs may be among user-defined energies: a run finds out from its tangent matrix
    springs_may_hold = bool(problem.loads.user_terms)
    if not unsupported or normals == 3 or problem.at_rest:
        return
    if problem.moves_freely or springs_may_hold:
        return
    if normals:
        raise CaseError(NOT_HELD + "move in its planes of symmetry" + problem.support_hint)
    raise CaseError(
        "boundary: nothing is held: clamp an edge or a patch, or hold points, for instance"
        + problem.support_hint
    )


def _number_lines(case: Case, problem: Problem) -> list[str]:
    """Return lines with dimensionless numbers, sizes in units, and numbers of the case's parts."""
    material = problem.material
    numbers = {
        "R/h": 1 / material.h,
        "nu": material.nu,
        "p_c/E": material.classical_pressure,
    }
    groups = dimensionless_groups(case.context, 1 / material.h)
    numbers |= {GROUPS[name]: value for name, value in groups.items()}
    # p_c is left out for a flat shell, unless it is the unit of a pressure
    is_flat = case.context.shell.geometry in FLAT_GEOMETRIES and not problem.loads.pressure
    if is_flat:
        del numbers["p_c/E"]
    lines = [f"{name} = {value:.6g}" for name, value in numbers.items()]
    lines += _in_units(case, without="p_c" if is_flat else "")
    if case.several:
        lines += case.several.scale_lines
    for ability in case.context.abilities:
        lines += ability.numbers(case.context)
    return lines


def _mesh_lines(problem: Problem, patch: PatchMesh | None) -> list[str]:
    """Return lines on the size of a mesh, and on what a mesh file contains.

    `patch` is the triangulation; None for a meridian.
    """
    cells, unknowns = _count(problem, patch)
    if problem.loads.interaction:
        refuse_large(unknowns)
    refuse_overlap(problem, cells)
    lines = [f"mesh: {cells} cells of degree {degree_of(problem.context)}, {unknowns} unknowns"]
    if patch is None:
        return lines
    if isinstance(problem.shape, MeshFile):
        lines += _surface_lines(patch)
    return lines


def _in_units(case: Case, without: str) -> list[str]:
    """Return lines with the scales of a case in units, such as "h = 0.2 mm".

    The scale `without` is left out. There are no lines for a case without units.
    """
    sizes = sizes_of(case.context)
    words_and_units = {  # scale -> words and unit of its size
        "h": ("h", "mm"),
        "p_c": ("p_c", "Pa"),
        "2πD/R": ("2 pi D/R", "N"),
        "λ_m": ("applied field", sizes.field),
    }
    # of a load whose strength the case gives, the size of its scale is that of a strength of one
    factor = {
        quantity(amplitude(name).column).scale: strength
        for name, strength in case.context.strengths.items()
    }
    shown_scales = {
        scale: words
        for scale, words in words_and_units.items()
        if scale in sizes.by_unit and scale != without
    }
    return [
        f"{name} = {sizes.by_unit[scale] * factor.get(scale, 1.0):.6g} {unit}"
        for scale, (name, unit) in shown_scales.items()
    ]


def _edges_without_potential(problem: Problem, patch: PatchMesh | None) -> tuple[str, ...]:
    """Return the names of the edges at which a live pressure has no potential.

    `patch` is the triangulation, if it is made already.
    """
    span = problem.meridian
    if span is None:  # a triangulated surface
        return open_edges(
            patch or problem.triangulated(), problem.conditions, problem.loads.pressed_sides
        )
    # a meridian: its openings with a potential, and the names of the edges without one
    _, without_potential = ring_openings(
        span.ends(), problem.conditions, problem.loads.pressed_sides
    )
    return without_potential


def _surface_lines(patch: PatchMesh) -> list[str]:
    """Return lines on what a mesh file contains, so that its author can see how it was read."""
    places = patch.embedding(patch.nodes)
    a, b, c = places[patch.cells[0, :3]]  # corners of the first triangle
    normal = np.cross(b - a, c - a)
    extent, place = np.ptp(places, axis=0), (a + b + c) / 3
    unit_normal = normal / np.linalg.norm(normal)
    return [
        f"extent over the radius: {' x '.join(f'{side:.4g}' for side in extent)}",
        f"edges: {', '.join(patch.edges) or 'none'}; patches: {', '.join(patch.patches) or 'none'}",
        *([f"lines within: {', '.join(patch.inner_lines)}"] if patch.inner_lines else []),
        f"outside: the normal at {_vector_text(place)}, over the radius, "
        f"is {_vector_text(unit_normal)}",
    ]


def _vector_text(vector: NDArray[np.float64]) -> str:
    """Return a vector (3,) as text with four digits, without negative zeros."""
    return f"({', '.join(f'{x + 0.0:.4g}' for x in np.round(vector, 9))})"


def _count(problem: Problem, patch: PatchMesh | None) -> tuple[int, int]:
    """Return (number of cells, number of unknowns) of the mesh.

    `patch` is the triangulation; None for a meridian, whose cells are intervals.
    """
    degree = degree_of(problem.context)
    if patch is None:
        assert problem.meridian
        chart = problem.meridian
        # meridians that are joined end to end share a vertex, and count as one piece
        joined_count = sum(first == second for first, second in chart.joints)
        piece_count = max(len(chart.shell_meridians) - joined_count, 1)
        count = len(meridian_vertices(problem)) - piece_count
        # two components at each node; a piece has one node more than degree times its cells
        return count, 2 * (degree * count + piece_count)
    cell_count, corner_count = len(patch.corners), len(np.unique(patch.corners))
    # the two corners of each side, smaller number first: a side of two cells counts once
    sides = np.sort(patch.corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    side_count = len(np.unique(sides, axis=0))
    if problem.body:
        # a solid: each triangle is divided into three quadrilaterals, and above it each layer has
        # three hexahedra of degree two
        layers = len(problem.body.layer_bounds) - 1
        # nodes of one plane: at corners, three within each side, seven inside each triangle. There
        # are two planes for each layer, and one more; nodes have three components
        nodes_in_plane = corner_count + 3 * side_count + 7 * cell_count
        return 3 * cell_count * layers, 3 * (2 * layers + 1) * nodes_in_plane
    # a shell: nodes at corners, within sides and within cells, of three components
    nodes_in_cell = (degree - 1) * (degree - 2) // 2
    nodes = corner_count + (degree - 1) * side_count + nodes_in_cell * cell_count
    return cell_count, 3 * nodes
