"""Modes of the perfect shell as imperfections: the same by several ways, and the law of a symmetric
bifurcation.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import magshell
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.parts.imperfections.imperfection import imperfection_geometries
from magshell_fenicsx.parts.imperfections.modes import ModesSection, Round
from magshell_fenicsx.parts.shell_outline import outline, reference_shell_of
from magshell_fenicsx.public import Scene, run
from magshell_fenicsx.simulate.perfect import perfect_modes, with_modes
from magshell_fenicsx.simulate.sensitivity import with_changed_number

Array = NDArray[np.float64]
HEMISPHERE = {"geometry": "hemisphere", "radius_to_thickness": 12, "poisson_ratio": 0.3}


def case(*amplitudes: float, folder: Path = Path(), **item: Any) -> Case:
    items = [{"kind": "modes", "amplitudes": list(amplitudes), **item}] if amplitudes else []
    data = {"shell": {**HEMISPHERE, "imperfections": items}, "boundary": {"equator": "clamped"}}
    return Case.from_source(
        Source("case.yaml", data | {"loading": {"kind": "pressure"}}, folder=folder)
    )


def alike(here: Array, there: Array, tolerance: float) -> bool:
    """Equal but for the sign, which a mode has not."""
    return bool(min(np.abs(here - there).max(), np.abs(here + there).max()) < tolerance)


@pytest.mark.slow
def test_two_thirds_law() -> None:
    """At a symmetric, unstable bifurcation 1 - k_d/k_c falls as the imperfection to the power of
    2/3 (Koiter 1945).
    """
    critical, first, second = (
        run(case(*amplitude)).knockdown for amplitude in ((), (0.005,), (0.01,))
    )
    assert critical
    assert first
    assert second
    exponent = np.log2((critical - second) / (critical - first))
    assert exponent == pytest.approx(2 / 3, abs=0.01)


@pytest.mark.telling
@pytest.mark.usefixtures("no_pictures")
def test_a_mode_computed_and_from_the_file_of_a_run(tmp_path: Path) -> None:
    """The file has the mode on the nodes of the deformed surface, which other code evaluates."""
    (tmp_path / "perfect.yaml").write_text(
        f"shell: {HEMISPHERE}\nboundary: {{equator: clamped}}\nloading: {{kind: pressure}}\n"
    )
    assert magshell("run", tmp_path / "perfect.yaml", "--out", tmp_path / "out").returncode == 0
    (file,) = (tmp_path / "out/fields").glob("mode_*_bifurcation_m4.vtu")
    read = case(0.1, file=f"out/fields/{file.name}", folder=tmp_path)
    computed = with_modes(case(0.1).problem(), MPI.COMM_SELF)
    (shape,) = computed.imperfections["imperfections.0"].shapes  # type: ignore[attr-defined]
    assert isinstance(shape, Round)
    assert shape.m == 4
    x = outline(read.shell).sample()
    x = x[x[:, 2] > 0.05]
    one, other = (
        next(
            iter(imperfection_geometries(sections, reference_shell_of(read.shell)).values())
        ).deviation(x)
        * 12
        for sections in (read.imperfections, computed.imperfections)
    )
    assert np.abs(other).max() == pytest.approx(0.1, rel=0.05)
    assert alike(one, other, 1e-3)
    assert read.outside["imperfections.0.file"]


def test_modes_of_half_and_full_shells() -> None:
    """A panel by half and whole: two meshes, the same lowest modes, exactly even or odd in the
    plane of the half.
    """
    shell = {
        "geometry": "cylinder",
        "radius": 1.0,
        "length": 0.8,
        "azimuth": [-30, 30],
        "thickness": 0.05,
    }
    edges = dict.fromkeys(("left", "right", "bottom", "top"), "clamped")
    load = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.05}
    data = {
        "shell": {**shell, "poisson_ratio": 0.3},
        "boundary": edges,
        "loading": load,
        "mesh": {"degree": 3},
    }
    panel = Case.from_source(Source("panel.yaml", data))
    x = outline(panel.shell).sample()
    whole_problem = panel.model_copy(update={"symmetry": "none"}).problem()
    # the part of each mode on the only shell
    whole, halves = (
        [mode[""] for mode in perfect_modes(problem, 2, MPI.COMM_SELF)]
        for problem in (whole_problem, panel.problem())
    )
    for one, other in zip(whole, halves, strict=True):
        assert np.abs(other(x)).max() == pytest.approx(1, abs=0.04)
        assert alike(one(x), other(x), 0.02)
    images = x * [1.0, -1.0, 1.0], [0.0, 0.0, 0.8] + x * [1.0, 1.0, -1.0]
    assert all(
        any(np.allclose(np.abs(f(image)), np.abs(f(x)), rtol=1e-9, atol=1e-12) for image in images)
        for f in halves
    )


CAP = {"geometry": "cap", "radius": 1, "polar": 40, "poisson_ratio": 0.3}


def of(data: dict[str, Any]) -> Case:
    return Case.from_source(Source("case.yaml", data))


@pytest.mark.slow
def test_a_single_shell_takes_its_mode_along_to_its_place() -> None:
    """A section `shells` may have one shell, whose mode is known in the frame of the case."""
    shell = {"geometry": "plate", "length": 1, "width": 0.3, "thickness": 0.02}
    shell |= {"poisson_ratio": 0.3, "imperfections": [{"kind": "modes", "amplitudes": [0.3]}]}
    held = {"left": "clamped", "right": "clamped"}

    def mode(place: dict[str, Any], way: list[float]) -> Any:
        """The mode of the plate, compressed along its first axis, in its own frame."""
        move = {"supports": ["a.right"], "translation": way}
        data = {"shells": {"a": {"shell": shell, "boundary": held, "place": place}}}
        plate = of(
            data
            | {"mesh": {"size": 0.15, "degree": 3}, "loading": {"kind": "edge", "moves": [move]}}
        )
        with_modes(plate.problem(), MPI.COMM_SELF)
        (member,) = plate.members
        (found,) = member.case.imperfections["imperfections.0"].shapes  # type: ignore[attr-defined]
        return found

    x = np.column_stack([np.linspace(0.05, 0.95, 7), np.full(7, 0.1), np.zeros(7)])
    upright = {"position": [0.3, 0.2, 0.1], "axis": {"polar": 90, "azimuth": 90}}
    here, there = mode({}, [-0.01, 0, 0]), mode(upright, [0, 0, 0.01])
    assert np.abs(here(x)).max() > 0.9
    assert alike(here(x), there(x), 1e-6)


@pytest.mark.slow
def test_modes_of_several_shells() -> None:
    """The thinner of two caps apart, upside down, buckles as it does alone, 1e-8, and the other one
    stays.

    Its mode, m = 4, has crests where the troughs are of one that is not upside down.
    """

    def one(thickness: float, *amplitudes: float, **place: Any) -> dict[str, Any]:
        items = [{"kind": "modes", "amplitudes": list(amplitudes)}] if amplitudes else []
        shell = CAP | {"thickness": thickness, "imperfections": items}
        return {"shell": shell, "boundary": {"rim": "clamped"}} | place

    def two(upper: dict[str, Any]) -> Case:
        return of({"shells": {"lower": lower, "upper": upper}, "loading": {"kind": "pressure"}})

    lower, place = one(0.03), {"place": {"position": [0, 0, 5], "axis": {"polar": 180}}}
    alone = run(of(one(0.02, 0.2) | {"loading": {"kind": "pressure"}})).knockdown
    together = run(two(one(0.02, 0.2, **place))).knockdown
    assert alone
    assert together
    assert together == pytest.approx(alone * (0.02 / 0.03) ** 2, rel=1e-8)
    lower = one(0.03, 0.2)
    with pytest.raises(
        CaseError,
        match=r"shells\.lower\.shell\.imperfections\.0\.amplitudes: of the 1 lowest modes",
    ):
        run(two(one(0.02, **place)))


@pytest.mark.slow
def test_modes_of_shells_that_are_joined() -> None:
    """A column of two plates, each with its part of the mode, bends as one plate with it does:
    1e-3, by the mesh.
    """

    def plate(length: float, **keys: Any) -> dict[str, Any]:
        size = {
            "length": length,
            "width": 0.3,
            "thickness": 0.02,
            "youngs_modulus": 1,
            "poisson_ratio": 0.3,
        }
        flaw = {"imperfections": [{"kind": "modes", "amplitudes": [0.1]}]}
        return {"shell": {"geometry": "plate", **size, **flaw}} | keys

    def pushed(edge: str) -> dict[str, Any]:
        force = {"edge": edge, "force": [-1, 0, 0]}
        return {
            "loading": {
                "kind": "dead",
                "control": "load",
                "loads": [force],
                "factor": 5e-8,
                "points": 1,
            }
        }

    root = {"boundary": {"left": "clamped"}}
    whole = run(of(plate(2, points={"tip": [2, 0, 0]}) | root | pushed("right"))).rows[-1]
    parts = {
        "one": plate(1) | root,
        "two": plate(1, points={"tip": [1, 0, 0]}, place={"position": [1, 0, 0]}),
    }
    joint = {"joints": [{"edges": ["one.right", "two.left"], "kind": "rigid"}]}
    joined = run(of({"shells": parts} | joint | pushed("two.right"))).rows[-1]
    assert abs(joined["two_tip_uz"]) == pytest.approx(abs(whole["tip_uz"]), rel=1e-3)


def test_amplitudes_are_parameters() -> None:
    found = with_changed_number(
        case(0.1, 0.2).imperfections, "imperfections.0", "amplitudes.1", 0.05
    )["imperfections.0"]
    assert isinstance(found, ModesSection)
    assert found.amplitudes == [0.1, 0.25]
    assert found.parameters == ("amplitudes.0", "amplitudes.1")


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CaseError, match="a file has one mode"):
        case(0.1, 0.2, file="mode.vtu")
    with pytest.raises(CaseError, match="with_modes"):
        Scene(case(0.1))
    (tmp_path / "mode.vtu").write_text("no file of VTK")
    for name in ("mode.vtu", "other.vtu"):
        read = case(0.1, file=name, folder=tmp_path)
        with pytest.raises(
            CaseError, match=rf"shell\.imperfections\.0\.file: {name}: is no mode file"
        ):
            imperfection_geometries(read.imperfections, reference_shell_of(read.shell))
