"""The bilayer of docs/howto.md against Timoshenko's bimetal, J.

Opt. Soc. Am. 11 (1925), 233-255.
"""

import re
from typing import Any

import numpy as np
import pytest
from conftest import CASES


@pytest.mark.slow
def test_the_bilayer_of_the_howto() -> None:
    """Its curvature is 6 (a2 - a1) (1 + m)^2 / (h (3 (1 + m)^2 + (1 + m n)(m^2 + 1/(m n)))), m =
    h1/h2, n = E1/E2.

    The strip's radius is that of the circle through three of its points, away from the root that
    holds its width.
    """
    page = (CASES.parent / "docs/howto.md").read_text(encoding="utf-8")
    (program,) = (
        code for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "plies" in code
    )
    found: dict[str, Any] = {}
    exec(program, found)
    m, n = 0.6 / 0.4, 1 / 3
    k = -6 * 0.002 * (1 + m) ** 2 / (3 * (1 + m) ** 2 + (1 + m * n) * (m**2 + 1 / (m * n)))
    assert found["k"] == pytest.approx(k, rel=1e-12)
    last = found["result"].rows[-1]
    x, y, z = (
        np.array([place + float(last[f"{name}_ux"]), float(last[f"{name}_uz"])])
        for name, place in (("B", 0.5), ("A", 0.75), ("tip", 1.0))
    )
    sides = [np.linalg.norm(a - b) for a, b in ((x, y), (y, z), (z, x))]
    radius = np.prod(sides) / (2 * abs(np.linalg.det([y - x, z - x])))
    assert radius == pytest.approx(1 / (200 * abs(k)), rel=1e-3)
    assert z[1] < -0.25
