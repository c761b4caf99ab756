"""Modes of the perfect shell that a problem has as imperfections.

They are computed once, before a scene is built. In: a problem whose imperfections ask for modes.
Out: the problem with these modes as functions of the place, inward displacements with the largest
value 1. The perfect shell is the same shell without imperfections, under the same loads.

A mode with m waves around a meridian has the label "m = 7"; its unknowns are U + V, V and W, with
the radial, azimuthal and axial displacement U, V and W. The label of an axisymmetric mode is "".
"""

import json
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.modes import ModesNotFound
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.imperfections.imperfection import in_frame
from magshell_fenicsx.parts.imperfections.modes import (
    MirroredMode,
    Mode,
    Shape,
    on_meridian,
    on_surface,
    over_largest,
)
from magshell_fenicsx.platform import compat
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.mode_labels import ANTISYMMETRIC, waves_of_label
from magshell_fenicsx.shells.modes import ShellMode, ShellModes
from magshell_fenicsx.shells.revolution import nodal_normals
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.path_records import LOCATED
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.transfer import all_nodes_of_shells, nodes_of_shells

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
MIN_DISPLACEMENT = (
    1e-6  # of the largest displacement: a shell that moves less is not moved by the mode
)
_known: dict[str, tuple[Mode, ...]] = {}  # a sweep has many cases with one perfect shell


def with_modes(problem: Problem, comm: MPI.Comm) -> Problem:
    """Return a problem with the modes of its perfect shell as imperfections; collective.

    Modes are remembered for other cases with the same perfect shell.

    Raises
    ------
    CaseError
        If the perfect shell cannot be built, or its modes are not found.
    """
    if problem.pending_modes is None:
        return problem
    count, perfect_problem = problem.pending_modes.count, problem.pending_modes.perfect()
    key_of_perfect_shell = json.dumps(
        [count, perfect_problem.document.data, perfect_problem.document.outside]
    )
    # without data, as of a problem that a program has made, the key says nothing
    if key_of_perfect_shell not in _known or not perfect_problem.document.data:
        if len(_known) > 3:  # a few are enough for a sweep
            _known.clear()
        _known[key_of_perfect_shell] = perfect_modes(perfect_problem, count, comm)
    return problem.pending_modes.with_modes(_known[key_of_perfect_shell])


def perfect_modes(problem: Problem, count: int, comm: MPI.Comm) -> tuple[Mode, ...]:
    """Return the lowest modes of a shell at its first instability; collective.

    Without an instability they are the modes at the end of its history.

    Parameters
    ----------
    count
        Number of modes.

    Raises
    ------
    CaseError
        If the shell has no load, or fewer modes.
    """
    scene = Scene(problem, comm)
    state = scene.unloaded()
    try:
        for record in follow(scene):
            state = record.point.state
            if record.label in LOCATED:
                break
    except Stopped:  # the last point that was reached
        pass
    if not any(state.mu.values()):  # all amplitudes are zero
        raise CaseError(
            "shell.imperfections: kind: modes: are those of a shell under a load, and there is none"
        )
    try:
        modes = ShellModes(scene.model).lowest(state, count)[:count]
    except ModesNotFound as e:
        raise CaseError(
            f"shell.imperfections: the modes of the perfect shell are not found: {e}"
        ) from None
    if len(modes) < count:
        raise CaseError(
            f"shell.imperfections: amplitudes: the perfect shell has only {len(modes)} modes, not "
            f"{count}"
        )
    return tuple(_shape(scene, mode) for mode in modes)


def _shape(scene: Scene, mode: ShellMode) -> Mode:
    """Return a mode as a function of the place, with largest value 1; collective.

    The function interpolates inward displacements at nodes. Of a half the other half's nodes, which
    are mirror images, count too. There is one function for each shell that the mode moves.
    """
    model, mirror = scene.model, None
    # nodes with their displacements, and for each shell a mask of its nodes
    if model.axisymmetric:
        places, inward_displacements = _along_meridian(model, mode)
        order = np.argsort(model.V.tabulate_dof_coordinates()[:, 0])
        is_of_shell = [is_own[order] for is_own in nodes_of_shells(scene)]
    else:
        assert model.thin
        places, inward_displacements = _at_nodes(scene, model, mode)
        is_of_shell = all_nodes_of_shells(scene)
        mirror = model.mirror if model.multiplicity > 1 else None
    node_count = len(places)
    sign_of_image = -1.0 if mode.label == ANTISYMMETRIC else 1.0
    if mirror:  # images follow the nodes, in the same order
        places = np.vstack([places, mirror.image(places)])
        inward_displacements = np.concatenate(
            [inward_displacements, sign_of_image * inward_displacements]
        )
    inward_displacements = over_largest(places, inward_displacements)

    def shape_of_shell(nodes: NDArray[np.int64]) -> Shape:
        """Return the mode of the shell with these nodes as a function of the place."""
        if model.axisymmetric:
            return on_meridian(
                places[nodes],
                inward_displacements[nodes],
                waves_of_label(mode.label) or 0,
            )
        if not mirror:
            return on_surface(places[nodes], inward_displacements[nodes], places[nodes])
        nodes_and_images = np.concatenate([nodes, node_count + nodes])
        function = on_surface(
            places[nodes_and_images], inward_displacements[nodes_and_images], places[nodes]
        )
        # from the model's frame to that of the case
        return in_frame(MirroredMode(function, mirror, sign_of_image), -scene.problem.azimuth)

    names = scene.problem.context.sections.get("shells") or [""]
    return {
        name: shape_of_shell(nodes)
        for name, nodes in zip(names, map(np.flatnonzero, is_of_shell), strict=True)
        if np.abs(inward_displacements[nodes]).max() > MIN_DISPLACEMENT
    }


def _along_meridian(model: "MeridianModel", mode: ShellMode) -> tuple[Array, Array]:
    """Return nodes (n, 3) and inward displacements (n,) in their order along the meridian.

    The displacements come from the coefficients (U + V, V, W) of a wave, or (U, W) of an
    axisymmetric mode.
    """
    V = model.waves.V if mode.label else model.V
    order, order_of_model = (
        np.argsort(space.tabulate_dof_coordinates()[:, 0]) for space in (V, model.V)
    )
    coefficients = mode.vector.reshape(len(order), -1)[order]
    in_plane = coefficients  # U and W at azimuth 0
    if mode.label:
        in_plane = np.column_stack([coefficients[:, 0] - coefficients[:, 1], coefficients[:, 2]])
    normal = nodal_normals(model.r0)[order_of_model][:, [0, 2]]  # along e_rho and e_z
    rho, z = model.r0.x.array.reshape(-1, 2)[order_of_model].T
    return np.column_stack([rho, 0 * z, z]), -np.einsum("ij,ij->i", in_plane, normal)


def _at_nodes(scene: Scene, model: "ShellModel", mode: ShellMode) -> tuple[Array, Array]:
    """Return all nodes (n, 3) and inward displacements (n,) there, on every rank; collective."""
    V, comm = model.V, scene.comm
    # nodes of each own cell: their numbers on this rank, and among all ranks
    dofs = V.dofmap.list[: V.mesh.topology.index_map(2).size_local]
    numbers = V.dofmap.index_map.local_to_global(dofs.ravel().astype(np.int32))
    table = V.element.basix_element.tabulate(1, compat.interpolation_points(V))[:, :, :, 0]
    # (cells, nodes, 3): places, displacements and normals, whose lengths are area ratios
    r0, displacements = (
        x.reshape(-1, 3)[dofs] for x in (model.r0.x.array, model.system.with_ghosts(mode.vector))
    )
    _, r_1, r_2 = np.matmul(table[:, None], r0)  # derivatives of the places, whose product is n
    gathered = comm.allgather(
        (numbers, *(vectors.reshape(-1, 3) for vectors in (r0, displacements, np.cross(r_1, r_2))))
    )
    # one row for each node of each cell of all ranks
    node_numbers, x, displacements, normals_of_cells = (
        np.concatenate(part) for part in zip(*gathered, strict=True)
    )
    # the normals of all cells at a node are added
    sum_of_normals = np.column_stack(
        [np.bincount(node_numbers, component) for component in normals_of_cells.T]
    )
    n0 = sum_of_normals / np.linalg.norm(sum_of_normals, axis=1)[:, None]
    # each node once, though several cells share it; ascending, as the rows of n0
    _, first_occurrence = np.unique(node_numbers, return_index=True)
    return x[first_occurrence], -np.einsum("ij,ij->i", displacements[first_occurrence], n0)
