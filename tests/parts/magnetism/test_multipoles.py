"""Charges far from each other by multipoles of boxes: the sum over all pairs, and differences."""

import basix
import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism import coulomb, tree
from magshell_fenicsx.parts.magnetism.corotated_stiffness import BlockRotation
from magshell_fenicsx.parts.magnetism.coulomb import InteractingCharges
from magshell_fenicsx.parts.magnetism.magnetised_cells import MagnetisedShell
from magshell_fenicsx.parts.magnetism.multipole_expansion import CellNodes, InteractionHessian
from magshell_fenicsx.parts.magnetism.multipoles import harmonics, translations
from magshell_fenicsx.parts.magnetism.pairs import Stiffness

Array = NDArray[np.float64]
H, SIDES = 0.02, 5


def two_bowls() -> tuple[MagnetisedShell, NDArray[np.intp]]:
    """A sphere of 8 x 25 triangles, and the half of it each is in. The upper one is moved away."""
    element = basix.create_element(
        basix.ElementFamily.P, basix.CellType.triangle, 2, basix.LagrangeVariant.gll_warped
    )
    X, cells = element.points, list[Array]()
    for signs in np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).reshape(3, -1).T:
        corners = np.diag(signs)[:: int(np.prod(signs))]
        for i in range(SIDES):
            for j in range(SIDES - i):
                triples = [[(i, j), (i + 1, j), (i, j + 1)]]
                if i + j < SIDES - 1:
                    triples.append([(i + 1, j), (i + 1, j + 1), (i, j + 1)])
                for triple in triples:
                    weights = np.array([[SIDES - a - b, a, b] for a, b in triple]) / SIDES
                    cells.append(np.column_stack([1 - X.sum(axis=1), X]) @ weights @ corners)
    flat = np.array(cells)
    r0 = flat / np.linalg.norm(flat, axis=-1, keepdims=True)
    upper = r0[..., 2].mean(axis=1) > 0
    r0[upper, :, 2] += 0.6
    remanence = np.broadcast_to([0.6, 0.0, 0.8], r0.shape)
    return MagnetisedShell(element, r0, 0 * r0, element, np.array(remanence), H), upper.astype(
        np.intp
    )


def charged() -> tuple[InteractingCharges, Array]:
    shape, parts = two_bowls()
    none, x = np.zeros(0, dtype=np.intp), shape.r0
    bend = 0.03 * np.stack(
        [np.sin(3 * x[..., 1]), np.cos(2 * x[..., 0]), np.sin(2 * x[..., 0] + x[..., 1])], axis=-1
    )
    return InteractingCharges(shape, parts, none, none, MPI.COMM_SELF), x + bend


def test_translations() -> None:
    """1/|D + a - b| of random places, and the error of a box less when its size is halved: as its
    power ORDER + 1.
    """
    a, b = np.random.default_rng(1).uniform(-0.3, 0.3, (2, 100, 3))
    D, errors = np.array([[2.0, -1.0, 0.5]]), []
    for size in (1.0, 0.5):
        found = np.einsum(
            "bn,bc,cn->n", harmonics(size * b), translations(D)[0], harmonics(size * a)
        )
        exact = 1 / np.linalg.norm(D + size * (a - b), axis=1)
        errors.append(np.abs(found / exact - 1).max())
    assert errors[0] < 1e-4
    assert errors[1] < 1.5 * errors[0] / 2**8


def test_far_sum_against_all_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Energy 1e-6 and forces on nodes 1e-4 of the sum over all pairs of charges; without net force,
    to rounding.
    """
    monkeypatch.setattr(coulomb, "PRECISION", 1e-8)
    found = []
    for apart in (tree.MAX_RADII_OVER_DISTANCE, 0.0):
        monkeypatch.setattr(tree, "MAX_RADII_OVER_DISTANCE", apart)
        charges, nodes = charged()
        own = range(len(nodes))
        found.append(charges.evaluate(nodes, own))
        assert np.abs(found[-1][1].sum(axis=(0, 1))).max() < 1e-12 * np.abs(found[-1][1]).sum()
        direct = charges.boxes(nodes, own)[1].sum()
        assert (direct < 0.5 * len(own) ** 2 / 2) if apart else (direct == len(own) ** 2 / 2)
    (energy, gradient), (exact, exact_gradient) = found
    assert energy == pytest.approx(exact, rel=1e-6)
    assert np.linalg.norm(gradient - exact_gradient) < 1e-4 * np.linalg.norm(exact_gradient)


def test_derivatives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forces are the slope of the energy, the stiffness that of the forces: differences with the
    same rules, 1e-6.
    """
    charges, nodes = charged()
    own, step, v = range(len(nodes)), 1e-5, np.cos(2 * nodes[..., [1, 2, 0]] + nodes)
    numbers = np.arange(nodes[..., 0].size).reshape(
        len(nodes), -1
    )  # each cell has nodes of its own
    rules = charges.rules(nodes, own)
    monkeypatch.setattr(charges, "rules", lambda nodes, own: rules)
    far, near = charges.boxes(nodes, own)
    beside = np.kron(
        near | np.eye(len(nodes), dtype=bool), np.ones(2 * [numbers.shape[1]], dtype=bool)
    )
    stiffness = Stiffness(beside, 1.0, numbers, numbers, np.eye(3)[None])
    _, gradient = charges.evaluate(nodes, own, stiffness)
    cells = CellNodes(numbers, own, numbers, np.arange(numbers.size), stiffness.turn)
    kept, turning = np.ones(len(stiffness.columns), dtype=bool), BlockRotation(MPI.COMM_SELF)
    acting = InteractionHessian(
        stiffness, far, far.jacobian(far.place_charges(nodes)), 1.0, cells, 1.0, kept, turning
    )
    product = acting.near_blocks @ v.ravel() + acting.times_far(v.reshape(-1, 1))[:, 0]
    ways = ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12))
    moved = [(w / step, charges.evaluate(nodes + k * step * v, own)) for k, w in ways]
    assert charges.boxes(nodes, own)[0] is far, "cells stay in their boxes"
    slope = sum(w * energy for w, (energy, _) in moved)
    assert slope == pytest.approx(np.vdot(gradient, v), rel=1e-6)
    change = sum(w * forces for w, (_, forces) in moved).ravel()
    assert np.linalg.norm(product - change) < 1e-6 * np.linalg.norm(change)
