"""Small shells that several tests share."""

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib import import_module
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from magshell_fenicsx.mesh.midsurface import Midsurface, distribute
from magshell_fenicsx.mesh.patch import DeviatedEmbedding, Embedding
from magshell_fenicsx.mesh.shapes import DiscShape, plane_embedding, sphere_embedding
from magshell_fenicsx.mesh.triangulation import triangulate
from magshell_fenicsx.models.shell.parameters import Condition, Material
from magshell_fenicsx.parts.imperfections.dimple import Dimple
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import MagneticEnergy, Magnetisation
from magshell_fenicsx.shells.shell import ShellModel

# ranks that wait for each other let others go on: beside another test they take a fifth of the
# time, and of the CPU
os.environ.setdefault("OMPI_MCA_mpi_yield_when_idle", "1")
TESTS = Path(__file__).parent
CASES = TESTS.parent / "cases"
CAP = """
shell:
  geometry: cap
  radius: 40 mm
  thickness: 0.8 mm
  polar: 45
  youngs_modulus: 1.3 MPa
  poisson_ratio: 0.49
  imperfections: [{kind: dimple, amplitude: 0.8, width: 3}]
boundary: {rim: clamped}
magnetic: {remanent: {flux_density: 60 mT}, applied: {flux_density: 10 mT}}
mesh: {degree: 3, refinement: 0.5}
loading: {kind: pressure, until: limit}
"""  # in units, with a dimple, in a field
STRIP = """
shell: {geometry: strip, radius: 17.2 mm, width: 0.29, thickness: 0.84 mm, \
youngs_modulus: 900 kPa, poisson_ratio: 0.49}
boundary: {root: clamped}
points: {tip: [17.2 mm, 0 mm, 0 mm]}
magnetic:
  remanent: {polar: 80, flux_density: 143 mT}
  applied: {polar: 0, flux_density: 20 mT}
mesh: {degree: 3, refinement: 0.5}
loading: {kind: field, points: 4}
"""  # in units, bent by a field
TILTED = Magnetisation(np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.28, 0.96]))


deselected_of_folder = Counter[
    str
]()  # number of slow tests that are left out, by the folder of tests/


def pytest_deselected(items: Sequence[pytest.Item]) -> None:
    """Count the slow tests that are left out."""
    slow_tests = (item for item in items if item.get_closest_marker("slow"))
    deselected_of_folder.update(item.path.relative_to(TESTS).parts[0] for item in slow_tests)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Send the count from a worker to its controller, which collects nothing itself."""
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["deselected"] = dict(deselected_of_folder)


@pytest.hookimpl(optionalhook=True)  # of pytest-xdist
def pytest_testnodedown(node: Any) -> None:
    """Take the count of one worker: all collect the same tests. A worker that crashed has none."""
    if not deselected_of_folder:
        deselected_of_folder.update(getattr(node, "workeroutput", {}).get("deselected", {}))


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say what `make test-all` has beyond the tests that were run."""
    if deselected_of_folder:
        counts = ", ".join(
            f"{count} of {folder}" for folder, count in deselected_of_folder.most_common()
        )
        terminalreporter.write_line(
            f"make test-all has {deselected_of_folder.total()} slow tests more: {counts}"
        )


@pytest.hookimpl(trylast=True)  # after tests that are not asked for have been left out
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Each of several workers begins with files that have slow tests: what it takes from others at
    the end is short.

    pytest-xdist gives each an equal part of the list, one after the other; an idle one takes the
    last half of what another has left.
    """
    if (workers := int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))) == 1:
        return
    files = [list(tests) for _, tests in groupby(items, lambda item: item.path)]
    slow = [tests for tests in files if any(item.get_closest_marker("slow") for item in tests)]
    quick = [item for tests in files if tests not in slow for item in tests]
    parts = [
        [item for tests in slow[worker::workers] for item in tests] for worker in range(workers)
    ]
    left = len(items)
    for worker, part in enumerate(parts):
        size = left // (workers - worker)
        left -= size
        missing = max(size - len(part), 0)
        part += quick[:missing]
        del quick[:missing]
    items[:] = [item for part in parts for item in part] + quick


@pytest.fixture(autouse=True)
def _no_reminders(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Studies say no more than their lines, however slow the machine is."""
    if request.path.parent.name == "studies":
        monkeypatch.setattr("magshell_fenicsx.studies.runner.SECONDS_BETWEEN_LINES", 3600.0)


def hemisphere(
    size: float = 0.5, *, half: bool = False, dimple: Dimple | None = None
) -> Midsurface:
    """A coarse hemisphere; the size holds everywhere."""
    points = {"pole": np.zeros(2), "load": np.array([np.pi / 4, 0.0])}
    shape = DiscShape(np.pi / 2, half, (dimple.width,) if dimple else ())
    return distribute(triangulate(shape, lambda x: size, points, spherical(dimple)), MPI.COMM_SELF)


def spherical(dimple: Dimple | None) -> Embedding:
    """The sphere with a dimple at its pole."""
    return (
        DeviatedEmbedding(sphere_embedding, sphere_embedding, (dimple,))
        if dimple
        else sphere_embedding
    )


def disc(size: float, *, half: bool = False) -> Midsurface:
    """A flat disc of radius 1."""
    points = {"pole": np.zeros(2)}
    return distribute(
        triangulate(DiscShape(1.0, half), lambda x: size, points, plane_embedding), MPI.COMM_SELF
    )


@pytest.fixture(scope="session")
def shell() -> Callable[..., ShellModel]:
    """Makes (once each) a coarse dimpled hemisphere with every load."""

    @cache
    def make(
        degree: int, half: bool = False, held: bool = True, energy: MagneticEnergy = "full"
    ) -> ShellModel:
        edges: Mapping[str, Condition] = {"rim": "clamped"} if held else {}
        if half:
            edges = {**edges, "symmetry": "symmetry"}
        surface = hemisphere(half=half, dimple=Dimple(0.05, 0.5))
        return ShellModel(
            surface,
            Material(0.3, 0.05),
            degree,
            edges,
            Loads(pressure=True, magnetic=replace(TILTED, energy=energy)),
        )

    return make


@pytest.fixture
def no_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs in this process draw nothing, which saves two seconds each."""
    draw_nothing(monkeypatch)


def draw_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        import_module("magshell_fenicsx.runs.running"), "_draw", lambda folder: None
    )


def random_displacement(model: ShellModel, size: float, seed: int = 0) -> Any:
    """Random nodal values; edges open and curvatures jump, unlike in any smooth field."""
    rng = np.random.default_rng(seed)
    return size * rng.standard_normal(model.system.size)
