"""Forces and moments of supports on the shell, from the residual at the nodes that they hold.

Forces are over E h R, moments over E h R^2, places over R; E, h and R are Young's modulus,
thickness and reference length. Unknowns have three components at a node, or two (away from the axis
e3 and along it) on a meridian. A mirror is the plane of a half model, or both planes of a sector;
its removed edges are those of the whole shell that the model does not have.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.prescribed_motion import vectors_in_space
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.parts.supports.support_motion import PRECEDENCE

if TYPE_CHECKING:
    from magshell_fenicsx.parts.observed_model import ObservedModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Reaction:
    """Force and moment of a support on the whole shell.

    Attributes
    ----------
    force, moment
        (3,) over E h R, and (3,) over E h R^2 about `point`.
    point
        (3,) over R: the middle of the bounding box of the support's present place.
    """

    force: Array
    moment: Array
    point: Array

    def image(self, S: Array, point: Array) -> "Reaction":
        """Return the reaction of the support's mirror image.

        Parameters
        ----------
        S
            (3, 3) reflection of vectors.
        point
            (3,) the image of the point.
        """
        return Reaction(S @ self.force, -S @ self.moment, point)

    def of_both_halves(self, mirror: Mirror) -> "Reaction":
        """Return the whole reaction of a support that is its own image, from that of a half."""
        return Reaction(
            mirror.sum_over_images(self.force),
            mirror.sum_over_images(self.moment, -1.0),
            self.point,
        )


def reactions(
    model: "ObservedModel", state: State, mirror: Mirror | None = None
) -> dict[str, Reaction]:
    """Return the reactions of all supports by name, in the model's frame; collective.

    A point has the force of its node; edges and patches that hold a node together share its force
    equally. A clamped edge also makes a couple. Its energy is invariant if shell and edge turn
    together, so the couple is minus the moment of that energy's gradient.

    Parameters
    ----------
    mirror
        Mirror of a half model or a sector: the reactions are those of the whole shell.
    """
    system, comm = model.system, model.system.comm
    residual, shares = system.forces(state.u, state.mu), _shares(model)
    axes = system.u.function_space.dofmap.index_map_bs  # components at a node
    # present places (nodes, 3) of this rank's nodes
    r = vectors_in_space(
        model.r0.x.array[: system.size] + system.with_ghosts(state.u, state.mu)[: system.size], axes
    )
    by_support: dict[str, Reaction] = {}
    for name, support in model.supports.items():
        # the point of the moment: the middle of the support, with its image if it is its own
        dofs = support.dofs[support.dofs < system.size]
        is_own_image = mirror is not None and mirror.image_of_edge(name) == name
        held_nodes = np.unique(dofs // axes)
        box_corners = _box(r[held_nodes], mirror if is_own_image else None, comm)
        point = box_corners.mean(axis=0)
        # forces F (nodes, 3) at the nodes, and their moment M about the point
        F, arm = vectors_in_space(shares[name] * residual, axes), r - point
        M = np.cross(arm, F).sum(axis=0)
        if support.edge:  # a clamped edge: the name of the energy that holds its normal
            gradient = vectors_in_space(system.forces(state.u, state.mu, support.edge), axes)
            M = M - np.cross(arm, gradient).sum(axis=0)
        force, moment = comm.allreduce(np.array([F.sum(axis=0), M]))
        if axes == 2:  # a meridian: around the axis all but the force along it cancels
            force, moment, point = force * [0.0, 0.0, 1.0], 0 * moment, point * [0.0, 0.0, 1.0]
        by_support[name] = Reaction(force, moment, point)
    return _of_whole(by_support, mirror) if mirror else by_support


def weights(
    model: "ObservedModel", name: str, direction: Array, mirror: Mirror | None = None
) -> Array:
    """Return weights e of the residual R, such that e . R is a support's force along a direction.

    The force is that on the whole shell, as in `reactions`.

    Parameters
    ----------
    name
        Name of the support.
    direction
        (3,) in the model's frame.
    mirror
        Mirror of a half model; None if all is modelled.

    Returns
    -------
    Array
        (unknowns,) on this rank; the products must be summed over ranks.
    """
    if mirror and name in mirror.removed_edges:  # its force is the image of the modelled edge's
        name, direction = mirror.removed_edges[name], mirror.reflection @ direction
    elif mirror and mirror.image_of_edge(name) == name:  # both halves of the support
        direction = mirror.sum_over_images(direction)
    system = model.system
    axes = system.u.function_space.dofmap.index_map_bs  # components at a node
    # on a meridian the force along the axis is left; all else cancels around it
    components = direction if axes == 3 else np.array([0.0, direction[2]])
    return np.asarray(_shares(model)[name] * np.tile(components, system.size // axes))


def _shares(model: "ObservedModel") -> dict[str, Array]:
    """Return each support's share in the force at each of this rank's unknowns.

    A share is between 0 and 1, in an array of this rank's unknowns. A point has the whole force of
    its node. Edges and patches share the force of any other node equally. A mirror plane has what
    is left.
    """
    size = model.system.size  # number of unknowns
    shares = {name: np.zeros(size) for name in model.supports}
    is_unassigned = np.ones(size, dtype=bool)
    for kind in PRECEDENCE:
        names = [name for name, support in model.supports.items() if support.kind == kind]
        # 1 at the unknowns that a support holds, if none of an earlier kind holds them
        for name in names:
            dofs = model.supports[name].dofs
            shares[name][dofs[dofs < size]] = 1.0
            shares[name] *= is_unassigned
        # equal shares of all supports of this kind
        number_of_holders = sum((shares[name] for name in names), np.zeros(size))
        for name in names:
            shares[name] /= np.maximum(number_of_holders, 1.0)
        is_unassigned &= number_of_holders == 0
    return shares


def _of_whole(half: Mapping[str, Reaction], mirror: Mirror) -> dict[str, Reaction]:
    """Return the reactions of the whole shell from those of a half.

    Supports on edges that are not modelled get the images of those that are. A support that is its
    own image gets the sum over both halves.
    """
    reactions_of_whole, S = dict(half), mirror.reflection
    for removed_edge, modelled_edge in mirror.removed_edges.items():
        if modelled_edge in half:
            reaction = half[modelled_edge]
            reactions_of_whole[removed_edge] = reaction.image(S, mirror.image(reaction.point))
    for name, reaction in half.items():
        if mirror.image_of_edge(name) == name:
            reactions_of_whole[name] = reaction.of_both_halves(mirror)
    return reactions_of_whole


def _box(places: Array, mirror: Mirror | None, comm: MPI.Comm) -> Array:
    """Return the corners (2, 3) of the box around places (n, 3) of all ranks; collective.

    With a mirror, the box also contains the images of the places.
    """
    if mirror:
        places = mirror.with_images(places)
    corners = np.array([places.min(axis=0, initial=np.inf), places.max(axis=0, initial=-np.inf)])
    all_corners = np.array(comm.allgather(corners))
    return np.array([all_corners[:, 0].min(axis=0), all_corners[:, 1].max(axis=0)])
