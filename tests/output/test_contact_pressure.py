"""The contact pressure in pictures: that of the points, or a statement where cells are too wide for
it.
"""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from conftest import CASES

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.mirror import Sector
from magshell_fenicsx.output.fields.contact_peak import ContactPeak, _along_meridian, _along_surface
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.surface import (
    GAP_OPEN,
    PRESSURE,
    RESOLVED,
    RESOLVED_PRESSURE,
    Surface,
    resolved_pressure,
)
from magshell_fenicsx.output.pictures.colours import contact, pressure_note
from magshell_fenicsx.output.pictures.plot import PicturedRun, with_contact_errors
from magshell_fenicsx.parts.penalty_contact import PressedPoints
from magshell_fenicsx.simulate.follow import follow


def end_of(name: str, *settings: str) -> tuple[Scene, State, Surface]:
    scene = Scene(Case.load(CASES / name, [*settings]))
    *_, record = follow(scene)
    state = record.point.state
    surface = gatherer(scene.model, scene.comm).gather(state.u, state.mu)
    assert surface is not None
    return scene, state, surface


@pytest.mark.slow
def test_a_ring_narrower_than_a_cell_has_no_pressure() -> None:
    """The rod's edge presses on a ring of 0.02 of a cell; its mean over the cell was drawn, 50
    times too small.
    """
    few = "loading.approach=0.5", "loading.points=1"
    scene, state, surface = end_of("rod_contact.yaml", *few)
    assert np.isnan(surface.fields[PRESSURE]).any()
    assert not (surface.fields[PRESSURE] > 0).any()
    assert [layer.name for layer in contact(surface)] == ["gap_over_h"]
    assert "narrower than a cell" in pressure_note(surface)
    row, h = scene.observe(state), scene.problem.material.h
    ring = 2 * np.pi * row["contact_radius"] / scene.problem.length
    force = row["rod_normal_force"] * 2 * np.pi * h**2 / 12 / (1 - 0.5**2)  # over E h R
    assert surface.contact_peak is not None
    assert surface.contact_peak.line_force == pytest.approx(force / ring, rel=1e-3)
    assert surface.contact_peak.force == pytest.approx(force)
    assert f"{force / ring:.3g} $Eh$" in pressure_note(surface)


def test_a_ring_around_a_touched_spot() -> None:
    """3 per length on a ring around a pole that touches with a thousandth of its pressure: the
    ring is a line, and of the pole no pressure is drawn.
    """
    rho = np.concatenate([np.linspace(1e-4, 0.1, 50), [0.4]])
    circumference, cell_length = 2 * np.pi * rho, 0.02
    pressure = np.append(np.full(50, 1e-3), 1.0)
    forces = np.append(1e-3 * circumference[:50] * 0.002, 3 * circumference[50])
    places = np.column_stack([rho, 0 * rho])
    cell_area = cell_length * np.maximum(circumference, np.pi * cell_length)
    points = PressedPoints(places, pressure, forces / pressure, cell_area)
    assert _along_meridian(points, forces) == pytest.approx(3)
    fields = {"gap_over_h": np.zeros(3), PRESSURE: np.array([1e-3, 1e-3, np.nan])}
    peak = ContactPeak(pressure=1.0, line_force=3.0, force=8.0)
    surface = cast(Surface, SimpleNamespace(fields=fields, contact_peak=peak))
    assert [layer.name for layer in contact(surface)] == ["gap_over_h"]
    assert "Its force per length is at most 3 $Eh$" in pressure_note(surface)
    surface.__dict__["contact_peak"] = replace(peak, is_median=True)
    assert "Its force per length has the median 3 $Eh$" in pressure_note(surface)


def test_the_images_of_a_line_are_one_line() -> None:
    """3 per length along a line through two mirror planes, of which a quarter of it is modelled."""
    x = np.arange(0.005, 0.5, 0.01)
    row = np.full(len(x), 1.0)
    places = np.column_stack([x, 0 * x, 0 * x])
    quarter = PressedPoints(places, 1.5e4 * row, 1e-6 * row, 4e-4 * row)
    whole = quarter.with_images(Sector(np.array([0.0, 1.0, 0.0]), waves=2))
    assert len(whole.pressure) == 4 * len(x)
    assert _along_surface(whole, whole.pressure * whole.area) == pytest.approx(3, rel=0.05)
    assert {(px > 0) for px in whole.places[:, 0]} == {True, False}


def test_points_along_a_fraction_of_a_cell_are_a_spot() -> None:
    """Three spots of 0.1 of a cell, whose points lie on lines: the mesh makes them lines."""
    x = np.concatenate([middle + np.linspace(-0.001, 0.001, 5) for middle in (0.0, 0.5, 1.0)])
    row = np.full(len(x), 1.0)
    spots = PressedPoints(np.column_stack([x, 0 * x, 0 * x]), row, row, 4e-4 * row)
    assert np.isnan(_along_surface(spots, row))


@pytest.mark.slow
def test_a_flat_contact_has_the_pressure_of_its_points() -> None:
    """What is drawn is what the quadrature points have, within the variation of one cell; outside
    it is zero.
    """
    few = "loading.approach=0.8", "loading.points=1", "mesh.refinement=4"
    scene, state, surface = end_of("plate_contact.yaml", "bodies.plate.stiffness=2e6", *few)
    largest, drawn = scene.observe(state)["contact_pressure_max"], surface.fields[PRESSURE]
    assert np.nanmax(drawn) == pytest.approx(largest, rel=0.33)
    assert surface.contact_peak is not None
    assert surface.contact_peak.pressure == pytest.approx(largest)
    assert f"{largest:.3g}" in pressure_note(surface)
    assert (surface.fields["gap_over_h"][drawn > 0] < 0.05).all()


def test_pressure_of_cells_pressed_in_part() -> None:
    """A row of cells: by itself such a cell has none, beside one that is pressed all over it is its
    edge.
    """
    cells = np.array([[i, i + 1, i + 1] for i in range(6)])
    even, of_cells = np.array([0, 1, 0, 0, 0, 0.0]), np.array([0.2, 1, 0.3, 0, 0, 0.7])

    def at_nodes(values: np.ndarray) -> np.ndarray:
        return np.array([values[0], *((values[1:] + values[:-1]) / 2), values[-1]])

    fields = {PRESSURE: at_nodes(of_cells), RESOLVED: at_nodes(even)}
    fields[RESOLVED_PRESSURE] = at_nodes(even * of_cells)
    fields[GAP_OPEN] = np.array([1, 0, 0, 1, 1, 1, 1.0])
    found = resolved_pressure(cells, fields)
    assert found.keys() == {PRESSURE}
    assert found[PRESSURE] == pytest.approx([0, 1, 1, 0, 0, np.nan, np.nan], nan_ok=True)


@pytest.mark.parametrize("rows", [1, 2])
def test_force_per_length(rows: int) -> None:
    """Points along a line, on one side of an edge or on both: 3 per length, whatever their rows; a
    spot has none.
    """
    x, size = np.arange(0, 1, 0.01), 0.02
    offsets = np.tile([0.0, 0.004][:rows], len(x))
    places = np.column_stack([np.repeat(x, rows), offsets, 0 * offsets])
    points = PressedPoints(
        places,
        np.full(len(places), 3e4 / rows),
        *(np.full(len(places), a) for a in (1e-6, size**2)),
    )
    found = _along_surface(points, points.pressure * points.area)
    assert found == pytest.approx(3, rel=0.05)
    square = np.random.default_rng(1).uniform(0, 0.01, places.shape) * [1, 1, 0]
    spot = replace(points, places=square)
    assert np.isnan(_along_surface(spot, points.pressure * points.area))


@pytest.mark.parametrize(("label", "point"), [("target", 2), ("fold", 1)])
def test_the_note_has_the_error_of_the_mesh(label: str, point: int) -> None:
    """Errors of the last point stand beside its numbers alone; those of two bodies add up."""
    rows = [
        {
            "point": number, "branch": 0, "label": label, "amplitude": "force",
            "contact_pressure_max": 4.0, "a_normal_force": 1.0, "b_normal_force": 3.0,
        }
        for number in (1, 2)
    ]  # fmt: skip
    errors = {"contact_pressure_max": 0.2, "a_normal_force": 0.01, "b_normal_force": 0.03}
    run = SimpleNamespace(
        rows=rows,
        headline=rows[point - 1],
        errors={f"{column}@end": error for column, error in errors.items()},
        resolved={"bodies": {"a": {}, "b": {}}},
    )
    points, fields = np.zeros((3, 3)), {PRESSURE: np.full(3, 2.0), "gap_over_h": np.zeros(3)}
    peak = ContactPeak(pressure=4.0, line_force=0.5, force=4.0)
    surface = Surface(points, points, points, np.array([[0, 1, 2]]), fields, contact_peak=peak)

    def note(pressure: float) -> str:
        fields[PRESSURE][:] = pressure
        return pressure_note(with_contact_errors(surface, cast("PicturedRun", run)))

    is_last = point == 2
    assert ("$pR/(Eh)$ = 4, with an error of 5\u00a0% by the mesh" in note(2.0)) == is_last
    assert ("0.5 $Eh$, with an error of 1\u00a0% by the mesh" in note(np.nan)) == is_last


def test_nothing_touches() -> None:
    """Nothing is drawn, in place of a bar from 0 to 1."""
    points = np.zeros((3, 3))
    fields = {PRESSURE: np.zeros(3), "gap_over_h": np.full(3, 2.0)}
    surface = Surface(points, points, points, np.array([[0, 1, 2]]), fields)
    assert contact(surface) == []
    pressed = replace(surface, fields=fields | {PRESSURE: np.array([1.0, 2.0, np.nan])})
    assert [layer.limits for layer in contact(pressed)][1] == (0.0, 2.0)
