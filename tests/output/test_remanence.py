"""The remanence in pictures: on both sides of a mirror plane, and without a field."""

import numpy as np
import pytest

import magshell_fenicsx as ms
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.surface import Surface, completed
from magshell_fenicsx.output.pictures.picture import figures
from magshell_fenicsx.output.pictures.rendering import Camera
from magshell_fenicsx.problem.requests import OutputSection

ABOVE = np.array([0.0, -1, 1])


def test_a_remanence_across_the_mirror_goes_on_behind_it() -> None:
    """Of the half y >= 0: one along e2 stays along e2 on the other side, one along e1 along e1, and
    w is even.
    """
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    for vector in ([0.0, 1, 0], [1.0, 0, 0], [0.6, 0, 0.8]):
        half = Surface(
            x,
            0.1 * x,
            np.tile([0.0, 0, 1], (3, 1)),
            np.arange(3)[None],
            {"Br": np.tile(vector, (3, 1))},
        )
        whole = completed(half, np.array([0.0, 1, 0]))
        assert whole.fields["Br"] == pytest.approx(np.tile(vector, (6, 1)))
        assert half.fields["Br"] == pytest.approx(np.tile(vector, (3, 1)))


def test_the_field_tells_where_the_remanence_jumps() -> None:
    """One that is e1 on the half x > 0 and -e1 on the other, in a field along e3: as its formula
    has it.
    """
    x = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    fields = {
        "Br": np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]),
        "Ba": np.tile([0.0, 0, 1e-3], (3, 1)),
    }
    whole = completed(
        Surface(x, 0 * x, np.tile([0.0, 0, 1], (3, 1)), np.arange(3)[None], fields),
        np.array([1.0, 0, 0]),
    )
    assert whole.fields["Br"][3:] == pytest.approx(-fields["Br"])
    assert whole.fields["Ba"][3:] == pytest.approx(fields["Ba"])


@pytest.mark.slow
def test_a_remanence_without_a_field_is_drawn() -> None:
    """On the meridian and on a whole strip; there are no loads, and what the meridian cannot show
    is left out.
    """
    strip = {"geometry": "strip", "radius_to_thickness": 50, "width": 0.2, "poisson_ratio": 0}
    dome = {"geometry": "hemisphere", "radius_to_thickness": 50, "poisson_ratio": 0.3}
    for shell, held, polar, shown in (
        (strip, "root", 90, ["Br"]),
        (dome, "equator", 0, ["Br"]),
        (dome, "equator", 90, []),
    ):
        sections = {
            "shell": shell,
            "boundary": {held: "clamped"},
            "magnetic": {"lambda_m": 0, "remanent": {"polar": polar}},
            "loading": {"kind": "pressure", "until": "target", "control": "load", "pressure": 0.01},
            "mesh": {"degree": 2, "refinement": 0.5},
        }
        scene = ms.Scene(ms.Case.from_source(sections))
        found = gatherer(scene.model, scene.comm).gather(scene.unloaded().u, {})
        assert found
        assert [name for name in found.fields if name in ("Br", "Ba", "p_mag", "k", "tau")] == shown
        assert found.jump == 0.0  # no moments yet
        if shown:
            assert np.linalg.norm(found.fields["Br"], axis=1) == pytest.approx(1.0)
            drawn = figures(
                found, 0.02, OutputSection(), Camera(ABOVE), ["fields", "magnetic_loads"]
            )
            assert list(drawn) == ["fields"]
