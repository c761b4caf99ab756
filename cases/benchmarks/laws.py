"""The paper's shell with each law of its material: k_d and the indentation, with the largest
strains there.

`.ci/in-env sh -c 'PYTHONPATH=cases python3 -m benchmarks.laws'` prints the rows of
docs/accuracy.md.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from magshell_fenicsx import Case
from magshell_fenicsx.models.shell.strains import TangentFrame, principal
from magshell_fenicsx.public import Scene
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record

CASES = Path(__file__).parents[1]
LAWS = {
    "koiter": ["shell.law=koiter"],
    "neo-hookean": ["shell.law=neo-hookean"],
    "mooney-rivlin": ["shell.law=mooney-rivlin", "shell.mooney=0.1"],
}
PLACES = np.linspace(0.02, 0.98, 9)[:, None]  # within each cell


def largest_strains(scene: Scene, record: Record) -> tuple[float, float]:
    """Of the middle layer and of the faces, on a meridian, a thickness away from the pole, where a
    force acts.
    """
    model, state = scene.model, record.point.state
    assert isinstance(model, MeridianModel)
    jets_of, h = model.domain.tables(model.V, PLACES), model.material.h
    r0, u = (jets_of(x) for x in (model.r0.x.array, state.u))
    frame = TangentFrame.from_jet(r0)
    E, K = frame.membrane_strain(u), frame.curvature_change(u)
    away = np.hypot(r0[0, ..., 0], r0[0, ..., 1]) > h

    def largest(strain: np.ndarray) -> float:
        return max(float(np.abs(each[away]).max()) for each in principal(strain))

    return largest(E), max(largest(E - h / 2 * K), largest(E + h / 2 * K))


def computed(file: str, law: str, R_over_h: float, *settings: str) -> tuple[Scene, list[Record]]:
    """A case with a law, on the meridian."""
    of_shell = [*LAWS[law], "shell.poisson_ratio=0.5", f"shell.radius_to_thickness={R_over_h:g}"]
    scene = Scene(Case.load(CASES / file, [*of_shell, "symmetry=axisymmetric", *settings]))
    return scene, list(follow(scene))


def rows() -> Iterator[str]:
    """Those of the table."""
    for R_over_h in (90, 40, 20):
        for law in LAWS:
            scene, records = computed("dimple_buckling.yaml", law, R_over_h)
            fold = next(record for record in records if record.label == "fold")
            size = fold.point.state.mu["pressure"]
            yield _row("k_d", R_over_h, law, size, largest_strains(scene, fold))
    for R_over_h in (90, 40):
        for law in LAWS:
            scene, records = computed("pole_indentation.yaml", law, R_over_h)
            targets = [record for record in records if record.label == "target"]
            for depth, record in ((1.5, targets[0]), (6, targets[-1])):
                force = record.point.state.mu["force"]
                yield _row(
                    f"F, w/h = {depth:g}", R_over_h, law, force, largest_strains(scene, record)
                )


def _row(what: str, R_over_h: float, law: str, value: float, strains: tuple[float, float]) -> str:
    middle, faces = (f"{100 * strain:.2g} %" for strain in strains)
    return f"| {what} | {R_over_h:g} | {law} | {value:.5f} | {middle} | {faces} |"


if __name__ == "__main__":
    for line in rows():
        print(line, flush=True)
