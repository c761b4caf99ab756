"""Scalar fields as variables of a design: values at points, between bounds, of which each place has the mean.

In the case such a field is a formula, with the weights of `models.shell.controls`: it needs no file, and its symmetry
is recognised by its values.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_derivative import FieldGradient
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.models.shell.controls import Controls
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Between:
    """The values of one field; as variables they run from 0 to 1 between their bounds.

    Attributes
    ----------
    start
        (n, components): factors of h, curvatures 11 and 22 over 1/R, or deviations over h.
    length
        R in the unit of the case's formulas, of a curvature.
    """

    name: str
    controls: Controls
    start: Array
    bounds: tuple[float, float]
    length: float = 1.0

    @property
    def first(self) -> Array:
        """The variables at the start."""
        return np.asarray((self.start - self.bounds[0]) / (self.bounds[1] - self.bounds[0])).ravel()

    def values(self, x: Array) -> Array:
        """(n, components) of variables."""
        low, high = self.bounds
        return np.asarray(low + x * (high - low)).reshape(self.start.shape)

    def gradient(self, scene: Scene, found: FieldGradient) -> Array:
        """By the variables; collective."""
        places = found.places.reshape(-1, 3) @ rotation(scene.plan.azimuth)
        forces = found.forces.reshape(len(places), -1)[:, : self.start.shape[1]]
        comm = found.field.function_space.mesh.comm
        pulled = comm.allreduce(np.asarray(self.controls.weights(places).T @ forces))
        unit = scene.plan.material.h if self.name == "deviation" else 1.0
        return np.asarray(pulled * unit * (self.bounds[1] - self.bounds[0])).ravel()

    def put(self, data: dict[str, Any], x: Array) -> None:
        """Give plain data of the case the field of variables."""
        texts = [self._formula(values) for values in self.values(x).T]
        if self.name == "thickness":
            data["shell"]["thickness_factor"] = texts[0]
        elif self.name == "deviation":
            shell = data["shell"]
            defect = [shell.pop("defect")] if shell.get("defect") else []
            shell["imperfections"] = [*defect, *(shell.get("imperfections") or ()), {"kind": "formula", "w0": texts[0]}]
        else:
            known = data.get("natural") or {}
            data["natural"] = {**known, "curvature": [*texts, 0]}

    def _formula(self, values: Array) -> str:
        R = self.length if self.name == "curvature" else 1.0  # other formulas are of places over R
        if np.ptp(values) == 0:
            return repr(float(values[0] / R))
        below = repr(float(self.controls.width * R) ** 2)
        weights = [f"exp(-({self._square(place * R)})/{below})" for place in self.controls.places]
        parts = (f"{float(v / R)!r}*{w}" for v, w in zip(values, weights, strict=True))
        return f"({' + '.join(parts)})/({' + '.join(weights)})"

    def _square(self, place: Array) -> str:
        names = ("sqrt(x**2 + y**2)", "z") if self.controls.around else ("x", "y", "z")
        return " + ".join(f"({name} - {float(c)!r})**2" for name, c in zip(names, place, strict=True))
