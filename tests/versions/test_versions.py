"""dolfinx 0.9, 0.10 and 0.11 give the same numbers, from the same source."""

import json

import pytest
from version_scenes import HERE, SCENES

MADE_WITH_0_9 = json.loads((HERE / "dolfinx_0.9.json").read_text(encoding="utf-8"))


@pytest.mark.telling
@pytest.mark.parametrize("scene", SCENES)
def test_same_numbers_as_with_dolfinx_0_9(scene: str) -> None:
    assert SCENES[scene]() == pytest.approx(MADE_WITH_0_9[scene], rel=1e-8, abs=0)
