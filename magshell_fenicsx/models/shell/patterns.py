"""Magnetisations that vary over the surface, as functions of the undeformed position and normal."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError

Array = NDArray[np.float64]
LARGEST = 1e6  # of a remanence's components
# (cells, nodes, 3) positions r0 and normals n0 -> (cells, nodes, 3) vectors
Pattern = Callable[[Array, Array], Array]


def radial(r0: Array, n0: Array) -> Array:
    """Along the normal."""
    return n0


def tangential(r0: Array, n0: Array) -> Array:
    """Along the meridians, away from e3; zero where the normal is along e3."""
    down = n0[..., 2:3] * n0 - np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(down, axis=-1, keepdims=True)
    return np.where(length > 1e-9, down / np.maximum(length, 1e-300), 0.0)


@dataclass(frozen=True)
class Components:
    """Three functions of x, y, z, perhaps of a frame whose axes (3, 3), told in this one, are columns of `frame`."""

    of_position: list[Callable[[Array, Array, Array], Array]]
    frame: Array | None = None

    def __call__(self, r0: Array, n0: Array) -> Array:
        if self.frame is not None:
            return np.asarray(Components(self.of_position)(r0 @ self.frame, n0) @ self.frame.T)
        return np.stack([f(*np.moveaxis(r0, -1, 0)) for f in self.of_position], axis=-1)


@dataclass(frozen=True)
class InsideAndOutside:
    """One vector within the colatitude `phi_o` (rad), another in the rest; the rim separates cells."""

    phi_o: float
    inside: Array
    outside: Array

    def __call__(self, r0: Array, n0: Array) -> Array:
        centre = r0.mean(axis=1, keepdims=True)
        phi = np.arctan2(np.hypot(centre[..., 0], centre[..., 1]), centre[..., 2])
        return np.broadcast_to(np.where(phi[..., None] < self.phi_o, self.inside, self.outside), r0.shape)


@dataclass(frozen=True)
class ByPatch:
    """A vector for each cell of this rank, ghosts included: (cells, 3)."""

    vectors: Array

    def __call__(self, r0: Array, n0: Array) -> Array:
        return np.broadcast_to(self.vectors[: len(r0), None], r0.shape)  # owned cells come first


def by_patch(vectors: Mapping[str, Array], patches: Mapping[str, NDArray[np.bool_]], cells: int) -> ByPatch:
    """A vector (3,) for each named patch of a mesh, and one for the "rest"; zero without.

    Parameters
    ----------
    patches
        Name -> whether each cell of this rank belongs to it.
    cells
        How many there are.

    Raises
    ------
    MeshError
        If there is no such patch.
    """
    found = np.tile(vectors.get("rest", np.zeros(3)), (cells, 1))
    for name, vector in vectors.items():
        if name in patches:
            found[patches[name]] = vector
        elif name != "rest":
            there = ", ".join(patches) or "none"
            raise MeshError(f"magnetic.remanent.patches: {name}: the surface has no such patch, only {there}")
    return ByPatch(found)


def pattern_field(pattern: Pattern, r0: fem.Function) -> fem.Function:
    """The pattern at the nodes of every cell, free to jump from cell to cell; collective.

    Raises
    ------
    MeshError
        On every rank, if it has no finite value somewhere.
    """
    V = r0.function_space
    element = V.element.basix_element
    values = element.tabulate(1, element.points)
    nodes = r0.x.array.reshape(-1, 3)[V.dofmap.list]
    a1, a2 = np.einsum("dvk,cki->dcvi", values[1:, :, :, 0], nodes)
    m = np.cross(a1, a2)
    n0 = m / np.linalg.norm(m, axis=-1, keepdims=True)
    Q = fem.functionspace(V.mesh, ("DG", element.degree, (3,)))
    field = fem.Function(Q, name="Br")
    vectors = pattern(nodes, n0)
    refuse_unbounded(vectors, nodes, V.mesh.comm)
    field.x.array.reshape(-1, 3)[Q.dofmap.list] = vectors
    return field


def refuse_unbounded(vectors: Array, nodes: Array, comm: MPI.Comm, key: str = "magnetic.remanent") -> None:
    """Look at vectors and places (cells, nodes, 3) of a key of the case; collective.

    Raises
    ------
    MeshError
        On every rank, if a vector is not finite.
    """
    bad = nodes[~(np.abs(vectors) <= LARGEST).all(axis=-1)][:1].tolist()
    if said := [place for places in comm.allgather(bad) for place in places]:
        x, y, z = said[0]
        raise MeshError(
            f"{key}: has no finite value (or one above {LARGEST:g}) at (x, y, z)/R = ({x:.3g}, {y:.3g}, {z:.3g})"
        )
