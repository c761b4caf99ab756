"""Charges of two parts that are far from each other: finer rules, and differences."""

import basix
import numpy as np
import pytest
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism import coulomb
from magshell_fenicsx.parts.magnetism.coulomb import InteractingCharges
from magshell_fenicsx.parts.magnetism.magnetised_cells import MagnetisedShell
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


def test_rules_against_finer_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Energy 1e-5 and forces on nodes 1e-3 of the sum with rules of a hundredth of the error;
    without net force, to rounding.
    """
    found = []
    for precision in (coulomb.PRECISION, coulomb.PRECISION / 100):
        monkeypatch.setattr(coulomb, "PRECISION", precision)
        charges, nodes = charged()
        found.append(charges.evaluate(nodes, range(len(nodes))))
        assert np.abs(found[-1][1].sum(axis=(0, 1))).max() < 1e-12 * np.abs(found[-1][1]).sum()
    (energy, gradient), (exact, exact_gradient) = found
    assert energy == pytest.approx(exact, rel=1e-5)
    assert np.linalg.norm(gradient - exact_gradient) < 1e-3 * np.linalg.norm(exact_gradient)


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
    stiffness = Stiffness((numbers.size, numbers.size), 1.0, numbers, numbers, np.eye(3)[None])
    _, gradient = charges.evaluate(nodes, own, stiffness)
    matrix = np.zeros((3 * numbers.size, 3 * numbers.size))
    stiffness.add_to(matrix, 1.0, sign=1.0)
    product = matrix @ v.ravel()
    ways = ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12))
    moved = [(w / step, charges.evaluate(nodes + k * step * v, own)) for k, w in ways]
    slope = sum(w * energy for w, (energy, _) in moved)
    assert slope == pytest.approx(np.vdot(gradient, v), rel=1e-6)
    change = sum(w * forces for w, (_, forces) in moved).ravel()
    assert np.linalg.norm(product - change) < 1e-6 * np.linalg.norm(change)
