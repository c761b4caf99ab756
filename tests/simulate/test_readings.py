"""Readings at places of a path: their slopes against differences of whole paths, which know nothing
of adjoints.
"""

from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import CAP, STRIP
from numpy.typing import NDArray

import magshell_fenicsx as ms
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.simulate.perturbation import perturbed_scene
from magshell_fenicsx.simulate.readings import PlaceOutsidePath, PrescribedQuantity, Reading, read
from magshell_fenicsx.simulate.scene_cache import SceneCache


def case_of(text: str, folder: Path, *settings: str) -> ms.Case:
    file = folder / "case.yaml"
    file.write_text(text)
    return ms.Case.load(file, list(settings))


def differences(case: ms.Case, wanted: list[Reading], key: str, step: float) -> NDArray[np.float64]:
    """Of the readings of two other cases, with a number more and less."""
    value = {
        "shell.youngs_modulus": case.shell.youngs_modulus,
        "shell.thickness": getattr(case.shell, "thickness", 0.0),
    }
    assert case.magnetic
    value["magnetic.remanent.polar"] = case.magnetic.remanent.polar  # type: ignore[union-attr]
    at, found = value[key], []
    assert at
    for way in (-1, 1):
        other = perturbed_scene(
            SceneCache(base=ms.Scene(case)), key, at * (1 + way * step)
        )  # on the same mesh
        found.append(read(other, wanted, [key], slopes=False).values)
    return np.asarray((found[1] - found[0]) / (2 * at * step))


@pytest.mark.parametrize(
    ("text", "settings", "wanted", "keys"),
    [
        pytest.param(
            STRIP,
            [],
            [
                Reading("tip_uz_mm", 5.0),
                Reading("tip_ux_mm", 20.0),
                Reading("tip_uz_mm", 12.0, change=True),
            ],
            ["magnetic.remanent.polar", "shell.thickness"],
            marks=pytest.mark.slow,
        ),
        # a pressure in pascals without a target: p_c, and so the load, changes with the thickness
        (
            CAP,
            ["loading={kind: pressure, control: arc, until: limit}"],
            [Reading("w_pole_mm", 80.0), Reading("volume_change_mm3", 150.0)],
            ["shell.thickness"],
        ),
        (
            CAP,
            ["loading={kind: indentation, at: {polar: 0}, depth: 1.2 mm, points: 3}"],
            [Reading("force_N", 0.3), Reading("force_N", 1.1)],
            ["shell.youngs_modulus", "shell.thickness"],
        ),
    ],
    ids=["strip", "pressure", "depth"],
)
def test_slopes(
    text: str, settings: list[str], wanted: list[Reading], keys: list[str], tmp_path: Path
) -> None:
    """1e-6 of differences of second order over 2e-4 of the number."""
    case = case_of(text, tmp_path, *settings)
    found = read(ms.Scene(case), wanted, keys)
    for i, key in enumerate(keys):
        by_runs = differences(case, wanted, key, 1e-4)
        assert found.slopes[:, i] == pytest.approx(
            by_runs, rel=1e-6, abs=1e-6 * np.abs(by_runs).max()
        ), key


def test_a_place_is_where_the_path_passes_it(tmp_path: Path) -> None:
    """The row of a run with this target."""
    case = case_of(STRIP, tmp_path)
    scene = ms.Scene(case)
    assert (PrescribedQuantity(scene).column, PrescribedQuantity(scene).by_conjugate) == (
        "applied_mT",
        False,
    )
    (row,) = (row for row in ms.run(case).rows if float(row["applied_mT"]) == pytest.approx(15.0))
    assert read(scene, [Reading("tip_uz_mm", 15.0)], []).values == pytest.approx(
        [float(row["tip_uz_mm"])], rel=1e-8
    )


def test_what_is_not_on_the_path(tmp_path: Path) -> None:
    scene = ms.Scene(case_of(STRIP, tmp_path))
    with pytest.raises(
        PlaceOutsidePath, match="applied_mT = 25 is outside the path, which goes from 0 to 20"
    ):
        read(scene, [Reading("tip_uz_mm", 25.0)], [])
    bare = case_of(
        CAP, tmp_path, "loading={kind: indentation, at: {polar: 0}, depth: 1.5, points: 3}"
    )
    with pytest.raises(
        CaseError, match=r"shell.thickness: changes the unit of w_\w*mm: give the target of loading"
    ):
        read(ms.Scene(bare), [Reading("force_N", 0.3)], ["shell.thickness"])
    data = yaml.safe_load(STRIP)
    del data["loading"], data["magnetic"]
    with pytest.raises(CaseError, match="no last step that prescribes"):
        PrescribedQuantity(ms.Scene(ms.Case.model_validate(data)))
