"""Maps of the field: the sensors' values and magpylib's at their places, files, picture and what is
refused.
"""

from itertools import combinations, product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from command import magshell
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.grids import grid_content, read_map
from magshell_fenicsx.output.fields.vtu import FieldSeries
from magshell_fenicsx.output.pictures.field_maps import (
    field_maps_figure,
    outlines,
    plane_of,
    section,
    with_holes,
)
from magshell_fenicsx.output.pictures.plot import PicturedRun, plot
from magshell_fenicsx.parts.magnetism.field_maps import maps_at
from magshell_fenicsx.parts.observables import MapGrid

MM = 1e-3
CAP = {"geometry": "cap", "radius": "20 mm", "thickness": "1 mm", "polar": 45,
       "youngs_modulus": "1 MPa",
       "poisson_ratio": 0.3}  # fmt: skip
BOX = {"corner": ["-12 mm", "1 mm", "8 mm"],
       "sides": [["24 mm", 0, 0], [0, "8 mm", 0], [0, 0, "9 mm"]],
       "points": [3, 2, 2], "field": "total"}  # fmt: skip
BELOW = {
    "corner": ["-2 mm", "-1 mm", "4 mm"],
    "sides": [["5 mm", 0, 0], [0, "3 mm", 0]],
    "points": [2, 2],
}
ACROSS = {
    "corner": [0, 0, "18.7 mm"],
    "sides": [["1 mm", 0, 0], [0, 0, "2.8 mm"]],
    "points": [2, 5],
}
POLAR = {"remanent": {"polar": 0, "flux_density": "60 mT"}, "applied": {"flux_density": "5 mT"}}
TILTED = {"remanent": {"polar": 40, "azimuth": 30, "flux_density": "60 mT"},
          "applied": {"polar": 20, "azimuth": 30, "flux_density": "5 mT"}}  # fmt: skip


def case(
    magnetic: dict[str, Any] | None = None, symmetry: str = "auto", **sections: Any
) -> dict[str, Any]:
    given = {"shell": CAP, "boundary": {"rim": "clamped"}, "magnetic": magnetic or POLAR}
    given |= {"symmetry": symmetry} if symmetry != "auto" else {"mesh": {"size": "3 mm"}}
    given |= {"mesh": {"degree": 2, "size": "6 mm"}} if symmetry in ("half", "none") else {}
    loading = {
        "kind": "pressure",
        "control": "load",
        "until": "target",
        "pressure": 0.1,
        "points": 1,
    }
    return given | {"loading": loading} | sections


@pytest.mark.parametrize(
    ("symmetry", "magnetic"), [("auto", POLAR), ("half", TILTED), ("none", TILTED)]
)
def test_a_map_is_many_sensors(symmetry: str, magnetic: dict[str, Any]) -> None:
    """On each model the values are those of sensors there and of magpylib's charged triangles; nan
    in the material.
    """
    at = MapGrid(
        "box", MM * np.array([-12.0, 1, 8]), MM * np.diag([24.0, 8, 9]), (3, 2, 2), "T", "total"
    ).places
    sensors = {f"s{i}": {"position": x.tolist(), "field": "total"} for i, x in enumerate(at)}
    given = case(
        magnetic,
        symmetry,
        sensors=sensors,
        field_maps={"box": BOX, "across": ACROSS, "below": BELOW},
    )
    here = Scene(Case.from_source(given).problem())
    larger = 0.005 * here.model.r0.x.array[: here.model.system.size]
    state = State(larger, {**here.unloaded().mu, "lambda_m": 1e-3})
    box, across, below = maps_at(here.view, state)
    row = here.observe(state)
    read = np.array([[row[f"s{i}_B{axis}"] for axis in "xyz"] for i in range(len(at))])
    np.testing.assert_allclose(box.values, read, rtol=1e-9, atol=1e-15)
    inside = (
        np.abs(np.linalg.norm(here.problem.length * across.places, axis=1) - 20.1 * MM) < 0.5 * MM
    )
    np.testing.assert_array_equal(np.isnan(across.values), np.repeat(inside[:, None], 3, axis=1))

    record: Any = SimpleNamespace(point=SimpleNamespace(state=state))
    rough, fine = (
        here.to_magpylib(record, parts).getB(here.problem.length * below.places) for parts in (2, 4)
    )
    np.testing.assert_allclose((4 * fine - rough) / 3, below.values, atol=1e-4 * np.abs(fine).max())


@pytest.mark.slow
def test_files_picture_and_report(tmp_path: Path) -> None:
    """A map is in fields/ at each point and on a list; it is drawn with the section of the shell, a
    circle's arc.
    """
    given = case(
        TILTED,
        "half",
        field_maps={"box": BOX, "across": ACROSS},
        mesh={"degree": 2, "size": "4 mm"},
    )
    (tmp_path / "case.yaml").write_text(yaml.safe_dump(given))
    out = tmp_path / "out"
    done = magshell("run", tmp_path / "case.yaml", "--out", out)
    assert done.returncode == 0, done.stderr
    assert (out / "field_maps.png").stat().st_size > 10_000
    assert "field lines and |B|" in (out / "report.html").read_text(encoding="utf-8")
    run = PicturedRun(out)
    points = len(run.rows)
    assert (out / "fields" / "map_box.pvd").read_text().count("map_box_") == points
    assert "map_" not in (out / "fields" / "path.pvd").read_text()
    (across, _), (box, R) = run.maps_at(run.rows[0])
    assert (box.points, box.unit, box.words, R) == ((3, 2, 2), "T", "total", pytest.approx(0.02))
    np.testing.assert_allclose(R * box.places[-1], MM * np.array([12.0, 9, 17]))
    plane = plane_of(box)
    np.testing.assert_array_equal(plane.values, box.values[6:])
    surface, about = run.surface_at(run.rows[0])
    level = MapGrid("level", np.array([-1.0, -1.0, 0.9]), 2 * np.eye(3)[:2], (2, 2), "T", "own")
    lines = section(surface, level)
    np.testing.assert_allclose(
        np.linalg.norm(lines[..., :2], axis=-1), np.sqrt(1 - 0.81), atol=5e-3
    )
    assert np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() == pytest.approx(
        2 * np.pi * 0.19**0.5, rel=5e-3
    )
    figure = field_maps_figure(
        [(box, R), (across, R), (box, R)], surface, about.h, run.resolved, run.style
    )
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[:2] == ["box\ntotal field, $z$ = 17 mm", "across\nown field, $y$ = 0 mm"]
    figure.draw_without_rendering()
    texts = [
        text for axes in figure.axes for text in (axes.title, axes.xaxis.label, axes.yaxis.label)
    ]
    boxes = [text.get_window_extent() for text in texts if text.get_text()]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    assert all(figure.bbox.count_contains(box.corners()) == 4 for box in boxes)
    assert "field_maps_0001.png" in plot(out, 1)
    (
        out / "fields" / f"map_across_{points - 1:04d}.vtu"
    ).unlink()  # that point is written again if a run goes on
    assert (
        FieldSeries(out / "fields", about, "", run.rows, ["box", "across"]).complete_points
        == points - 1
    )


def test_a_file_gives_back_its_grid(tmp_path: Path) -> None:
    grid = MapGrid(
        "g",
        np.zeros(3),
        np.diag([1.0, 2.0, 3.0])[:2],
        (3, 2),
        "|Br|",
        "own",
        np.arange(18.0).reshape(6, 3),
    )
    (tmp_path / "g.vtu").write_bytes(grid_content(grid, float("nan")))
    again, R = read_map(tmp_path / "g.vtu")
    assert np.isnan(R)
    np.testing.assert_array_equal(again.values, grid.values)
    np.testing.assert_array_equal(again.places, grid.places)
    (tmp_path / "g.vtu").write_bytes(grid_content(grid, 1.0)[:-200])
    with pytest.raises(CaseError, match=r"g.vtu: is damaged"):
        read_map(tmp_path / "g.vtu")


def test_the_section_of_a_solid() -> None:
    """Two squares, of which each side is two lines in any order, are two polygons."""
    square = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [1, 2], [0, 2], [0, 1.0]])
    lines = np.stack([square, np.roll(square, -1, axis=0)], axis=1)
    lines[::3] = lines[::3, ::-1]
    both = np.random.default_rng(1).permutation(
        np.concatenate([lines, 3 + 1.5 * lines, [[[1, 0], [1, 1e-12]]]])
    )
    areas = []
    for polygon in outlines(both):
        x, y = polygon.T
        areas.append(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2)
    np.testing.assert_allclose(sorted(areas), [4.0, 9.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "sections", [{}, {"model": "solid", "mesh": {"refinement": 0.4}}], ids=["shell", "solid"]
)
def test_ranks_and_resume(tmp_path: Path, sections: dict[str, Any]) -> None:
    """The same map on 1 and 2 ranks, of which one goes on from its first point."""
    given = case(TILTED, "half", field_maps={"box": BOX, "across": ACROSS}) | sections
    (tmp_path / "case.yaml").write_text(yaml.safe_dump(given))
    fields = []
    for name, more, ranks in [("1", ("--time-limit", 0), 1), ("2", (), 2)]:
        done = magshell("run", tmp_path / "case.yaml", "--out", tmp_path / name, *more, ranks=ranks)
        assert done.returncode == (3 if more else 0), done.stderr
        if more:
            assert not (tmp_path / name / "fields" / "map_box_0001.vtu").exists()
            done = magshell(
                "run", tmp_path / "case.yaml", "--out", tmp_path / name, "--resume", ranks=ranks
            )
            assert done.returncode == 0, done.stderr
        fields.append(read_map(tmp_path / name / "fields" / "map_box_0001.vtu")[0].values)
    for values in fields[1:]:
        np.testing.assert_allclose(values, fields[0], atol=1e-9 * np.abs(fields[0]).max())


def test_what_check_says() -> None:
    said = describe(Case.from_source(case(field_maps={"box": BOX})))
    assert "field map box: 3 x 2 x 2 places, total field" in said


@pytest.mark.parametrize(
    ("changed", "sections", "said"),
    [
        ({"points": [3, 2]}, {}, r"field_maps\.box: points: 2 numbers for 3 sides"),
        ({"points": [1000, 1000, 2]}, {}, r"field_maps\.box: points: more than 1000000 places"),
        ({"points": [3, 2, 1]}, {}, r"field_maps\.box\.points\.2"),
        ({"sides": [["1 mm", 0, 0]], "points": [3]}, {}, r"field_maps\.box\.sides"),
        (
            {"sides": [["1 mm", 0, 0], [0, 0, 0], [0, "1 mm", 0]]},
            {},
            r"field_maps\.box: sides: a side has no length",
        ),
        (
            {"sides": [[1, 0, 0], [1, 1, 0], [0, 0, 1]]},
            {},
            r"field_maps\.box: sides: are not perpendicular",
        ),
        ({"corner": [0, 0]}, {}, r"field_maps\.box\.corner"),
        ({}, {"magnetic": None}, "field_maps: need magnetic"),
        ({"field": "none"}, {}, r"field_maps\.box\.field"),
        ({}, {"field_maps": {"../box": BOX}}, "field_maps: ../box: a name is made of"),
        (
            {},
            {"magnetic": {"lambda_m": 1e-3}},
            "field_maps.box.field: total: lambda_m does not say",
        ),
    ],
)
def test_what_is_refused(changed: dict[str, Any], sections: dict[str, Any], said: str) -> None:
    data = {
        k: v
        for k, v in (case(field_maps={"box": BOX | changed}) | sections).items()
        if v is not None
    }
    with pytest.raises(CaseError, match=said):
        Case.from_source(data).problem()


def test_a_hole_in_a_cut_is_not_filled() -> None:
    """Of two circles, one in the other, drawn either way round, and of none."""
    angles = np.linspace(0, 2 * np.pi, 41)[:-1]
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    for outer, inner in product((circle, circle[::-1]), repeat=2):
        image = Figure(figsize=(1, 1), dpi=50)
        canvas = FigureCanvasAgg(image)
        axes = image.add_axes((0, 0, 1, 1), xlim=(-1.2, 1.2), ylim=(-1.2, 1.2))
        axes.set_axis_off()
        axes.add_patch(PathPatch(with_holes([outer, 0.5 * inner]), color="0"))
        canvas.draw()
        grey = np.asarray(canvas.buffer_rgba())[..., 0]
        assert [grey[25, x] for x in (1, 10, 25, 40)] == [255, 0, 255, 0]
    assert not len(with_holes([]).vertices)
