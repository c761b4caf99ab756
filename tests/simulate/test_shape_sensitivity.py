"""Sensitivities to the numbers of imperfections, against folds that are found again."""

import pytest
from conftest import CASES

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import Guess, find_fold
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.sensitivity import fold_at, sensitivities
from magshell_fenicsx.simulate.shape_sensitivity import changed
from magshell_fenicsx.simulate.transfer import transfer


@pytest.mark.parametrize("kind", ["dimple", "gaussian"])
def test_of_the_meridian(kind: str) -> None:
    """On meshes that follow the rim; off the pole the derivative is zero by symmetry, and is not asked for there."""
    one = f"[{{kind: {kind}, amplitude: 1.2, width: 2.5}}, {{kind: formula, w0: x**2 + y**2, amplitude: 0.1}}]"
    scene = Scene(Case.load(CASES / "dimple_buckling.yaml", [f"shell.imperfections={one}"]))
    *_, last = follow(scene)
    found = sensitivities(scene, fold := fold_at(scene, last))
    assert list(found) == ["imperfections.0.amplitude", "imperfections.0.width", "imperfections.1.amplitude"]
    for name, derivative in found.items():
        key, _, number = name.rpartition(".")

        def value(change: float, key: str = key, number: str = number) -> float:
            other = Scene(changed(scene.case, key, number, change))
            u, phi = (transfer(scene, other, v) for v in (fold.state.u, fold.phi))
            return find_fold(other.newton, Guess(State(u, fold.state.mu), phi), "pressure").value

        by_folds = (8 * (value(0.005) - value(-0.005)) - (value(0.01) - value(-0.01))) / 0.06
        assert derivative == pytest.approx(by_folds, rel=1e-4), name
