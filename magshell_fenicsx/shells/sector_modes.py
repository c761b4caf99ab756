"""Stability of a sector against the modes that its two planes exclude, on the half that its copies
make.

The mesh of the half is that of the sector and its images, so the state of the half is that of the
sector to rounding. Its own tangent and that of its antisymmetric modes count all modes of the
shell. Where nothing but the buckled shape itself distinguishes one azimuth from another, that shape
may turn about e3 without any force: this one direction is left out of the count, which would depend
on rounding.

A sector is the part of 180/m degrees between two symmetry planes through e3; m copies of it,
rotated or mirrored, make the half. To unfold is to make the half's mesh, or its displacement, from
the sector's. Unstable modes are counted as negative pivots of a factored tangent. A state is a
displacement u with amplitudes mu, the load parameters.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.stability_monitor import ModeFamily
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs
from magshell_fenicsx.mesh.midsurface import Midsurface, distribute
from magshell_fenicsx.mesh.mirror import SYMMETRY_EDGE, Sector
from magshell_fenicsx.mesh.unfolding import unfold, unfolding_of
from magshell_fenicsx.models.shell.antisymmetric import AntisymmetricModes

if TYPE_CHECKING:
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
AXISYMMETRY_TOLERANCE = (
    1e-3  # over the system's length: states that vary less around e3 are axisymmetric
)


class SectorModes:
    """Counts of the unstable modes that break a sector's symmetry.

    They are counted on the model of a half, which the copies of the sector make.

    Parameters
    ----------
    model
        Model of the sector.
    as_half
        Function of the mid-surface of a half that makes the model of the same shell on it.

    Attributes
    ----------
    _model, _as_half
        The parameters.
    _folding
        The map between charts of the half and of the sector; set with `half_model`, as are the two
        below.
    _numbers, _turns
        For each node of the half, the sector's node and the rotation (3, 3) that give its
        displacement.
    _own, _others
        Factors of the sector's tangent, and of that of the half.
    """

    # for a `StabilityMonitor`: modes are counted but not located, as the turned shape is always
    # neutral; changes of the counts are not located either
    families: Sequence[ModeFamily] = ()
    tangents = None

    def __init__(self, model: "ShellModel", as_half: "Callable[[Midsurface], ShellModel]") -> None:
        self._model, self._as_half = model, as_half
        self._own, self._others = Factorisation(model.system.comm), Factorisation(model.system.comm)

    @cached_property
    def half_model(self) -> "ShellModel":
        """Model of the half, whose tangents are counted; the first access is collective.

        It also sets the maps by which `unfold` takes displacements to the half.
        """
        sector, patch = self._model.mirror, self._model.midsurface.patch
        assert isinstance(sector, Sector)
        comm = self._model.system.comm
        # mesh of the copies, both of whose outer edges lie on the half's plane, and model on it
        self._folding = unfolding_of(sector, patch)
        patch_of_half = unfold(patch, self._folding, (SYMMETRY_EDGE, SYMMETRY_EDGE))
        half = self._as_half(distribute(patch_of_half, comm))
        chart_of_half = half.chart()
        # charts of all ranks' nodes of the sector, in the order in which `unfold` gathers
        # displacements
        chart_of_sector = np.concatenate(comm.allgather(self._model.chart()))
        # for each node of the half the node of the sector that has its displacement
        _, self._numbers = scipy.spatial.cKDTree(chart_of_sector).query(
            self._folding.to_sector(chart_of_half)
        )
        # and the rotation from there, that of the copy in which the node is
        turns_of_copies = np.array([self._folding.turn(k) for k in range(sector.waves)])
        self._turns = turns_of_copies[self._folding.copies(chart_of_half)]
        return half

    def unfold(self, u: Vector) -> Vector:
        """Return a sector's displacement on this rank as that of the half; collective."""
        half, system = self.half_model, self._model.system
        sector_values = np.concatenate(system.comm.allgather(u[: system.size].reshape(-1, 3)))
        values = np.einsum("nij,nj->ni", self._turns, sector_values[self._numbers])
        return np.asarray(half.system.zero_at_supports(values.ravel()))

    def counts(self, state: State) -> Sequence[int]:
        """Return two numbers of unstable modes at a state of the sector; collective.

        First the modes that are symmetric to the half but that the sector cannot have, then the
        modes antisymmetric to the half.
        """
        half, state_of_half = self.half_model, State(self.unfold(state.u), dict(state.mu))
        # symmetric modes: those of the half without those of the sector itself
        self._own.factor(self._model.system.tangent(state.u, state.mu))
        sector_pivots = self._own.negative_pivots
        self._others.factor(half.system.tangent(state_of_half.u, state_of_half.mu))
        symmetric = self._others.negative_pivots - sector_pivots
        # antisymmetric modes
        modes = half.symmetry_breaking_modes
        assert isinstance(modes, AntisymmetricModes)
        factors = modes.factor_at(state_of_half)
        antisymmetric = factors.negative_pivots
        # The turn v of the whole shape about e3 is neutral and left out: the tangent K has one
        # unstable mode less on the complement of v if v . K^-1 v is negative. v is None where the
        # shape cannot turn freely.
        turning = self._turning(state_of_half)
        if turning is not None and dot(half.system.comm, turning, factors.solve(turning)) < 0:
            antisymmetric -= 1
        return [max(symmetric, 0), antisymmetric]

    def _turning(self, state: State) -> Vector | None:
        """Return e3 x u - du/dtheta, by which the buckled shape turns about e3; collective.

        It is a displacement of the half, antisymmetric to its plane. None where the shell or its
        loads are not axisymmetric, or the state is axisymmetric itself. `state` is one of the half.
        """
        half = self.half_model
        system = self.half_model.system
        modes = self.half_model.symmetry_breaking_modes
        if not isinstance(modes, AntisymmetricModes) or not self._model.turns:
            return None
        V = half.V
        # displacements and places (nodes, 3)
        u, r0 = system.with_ghosts(state.u, state.mu).reshape(-1, 3), half.r0.x.array.reshape(-1, 3)
        dofs, element = V.dofmap.list, V.element.basix_element
        # derivatives of both by the reference coordinates, at the nodes of each cell
        table = element.tabulate(1, element.points)[1:, :, :, 0]
        tangents, du = (np.einsum("dqk,nki->nqdi", table, f[dofs]) for f in (r0, u))
        # change of places per radian about e3
        rotation = np.cross([0.0, 0.0, 1.0], r0[dofs])
        # du/dtheta: derivatives of u by reference coordinates, along e3 x r0 in the surface
        metric = np.einsum("nqdi,nqei->nqde", tangents, tangents)
        components = np.linalg.solve(
            metric, np.einsum("nqdi,nqi->nqd", tangents, rotation)[..., None]
        )[..., 0]
        by_angle = np.einsum("nqd,nqdi->nqi", components, du)
        # mean at each node over the cells that meet there
        sums = np.zeros_like(u)
        count = np.zeros(len(u))
        np.add.at(sums, dofs, by_angle)
        np.add.at(count, dofs, 1.0)
        turn = np.cross([0.0, 0.0, 1.0], u) - sums / np.maximum(count, 1.0)[:, None]
        turn = modes.system.zero_at_supports(turn.ravel()[: system.size])
        return turn if max_abs(system.comm, turn) > AXISYMMETRY_TOLERANCE * system.length else None
