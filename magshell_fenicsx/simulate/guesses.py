"""Guesses of snapped shapes: the shell with a part of it mirrored in a plane, as Pogorelov's dents are.

The mirrored part is an isometric copy of itself, so only the fold around it costs energy. The plane is parallel to
that of the supports; the fold is as wide as the boundary layer of a sphere, sqrt(2 h H) for a dent of depth H.
"""

from collections.abc import Iterator

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
DEPTHS = 0.9, 0.03, 0.8, 0.2  # of the dents, over the height of the shell above its supports
WIDTH = 0.2  # of half a fold, over sqrt(2 h H)
CLEAR = 3.0  # such widths between a fold and the supports
LEAST = 2.0  # shells of a smaller height, over h, are flat
ROUNDING = 1e-9
THIN = 1e-6  # a smaller mean square distance from a plane or a line, over the largest, is zero


def dented(scene: Scene, state: State) -> Iterator[State]:
    """Dented copies of a state, none of a flat shell; collective."""
    system, comm, h = scene.model.system, scene.model.system.comm, scene.plan.material.h
    x = (scene.model.r0.x.array[: system.size] + state.u).reshape(-1, scene.model.V.dofmap.bs)
    normal, level = _plane(scene, x)
    height = x @ normal - level
    top = float(comm.allreduce(float(height.max(initial=0.0)), MPI.MAX))
    bottom = float(comm.allreduce(float(height.min(initial=0.0)), MPI.MIN))
    if -bottom > top:  # it hangs down
        height, normal, top = -height, -normal, -bottom
    for depth in DEPTHS if top > LEAST * h else ():
        width = WIDTH * np.sqrt(2 * h * depth * top)
        above = height - max((1 - depth) * top, min(CLEAR * width, top / 2))
        dent = -2 * width * np.logaddexp(0.0, above / width)
        yield State(state.u + system.held(np.outer(dent, normal).ravel()), dict(state.mu))


def _plane(scene: Scene, x: Array) -> tuple[Array, float]:
    """The unit normal of the plane of the supports and its height along it; the best plane of a shell without any.

    Parameters
    ----------
    x
        Places (n, 2 or 3) of this rank's nodes.
    """
    held = np.zeros(len(x), dtype=bool)
    for support in scene.model.supports.values():
        held[support.dofs[support.dofs < x.size] // x.shape[1]] = True
    if scene.model.axisymmetric:
        return np.array([0.0, 1.0]), float(x[held, 1].mean()) if held.any() else 0.0
    level, spread = _moments(scene, x[held])
    size, axes = np.linalg.eigh(spread)
    if size[1] <= THIN * size[2]:  # on one line: the plane through it that is nearest to the shell
        _, spread = _moments(scene, x)
        along = np.outer(axes[:, 2], axes[:, 2]) if size[2] > 0 else np.zeros((3, 3))
        across = np.eye(3) - along
        size, axes = np.linalg.eigh(across @ spread @ across + along * np.trace(spread))
    normal = np.where(np.abs(axes[:, 0]) < ROUNDING, 0.0, axes[:, 0])
    normal /= np.linalg.norm(normal) * np.sign(normal[np.argmax(np.abs(normal))])
    return normal, float(level @ normal)


def _moments(scene: Scene, x: Array) -> tuple[Array, Array]:
    """The mean (3,) and the covariance (3, 3) of places of all ranks, of a half model with their mirror images."""
    comm, mirror = scene.model.system.comm, scene.plan.mirror
    if mirror:
        x = np.vstack([x, x - 2 * np.outer(x @ mirror.normal - mirror.offset, mirror.normal)])
    count = max(comm.allreduce(len(x)), 1)
    mean = comm.allreduce(x.sum(axis=0)) / count
    return mean, comm.allreduce((x - mean).T @ (x - mean)) / count
