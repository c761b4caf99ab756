"""Journal of the solves of a boundary of stability, from which an interrupted one goes on.

The boundary is a curve of instabilities in the plane of a load and a key of the case. A part of it
is the search of its start, or one direction from there. A solve gives a point of the boundary (a
locus), or a reason why there is none; solves of a part have numbers in their order.
"""

import base64
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from magshell_fenicsx.continuation.augmented import BoundaryPoint, CurveVector
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.studies.store import OutcomeStore


class Journal:
    """Results of a part of the boundary on disk: a file for each solve, and for the part.

    `recorded` replays the solves of an interrupted boundary, if the present sources have computed
    them.

    Attributes
    ----------
    _store
        The stored results.
    _name
        Begin of the names of the files, made of identity and part.
    _count
        Number of solves so far, stored or computed.

    Parameters
    ----------
    folder
        Folder of the files.
    identity
        Hash of case, range and start.
    part
        Name of the part: "start", "whole", "up" or "down".
    """

    def __init__(self, folder: Path, identity: str, part: str) -> None:
        self._store = OutcomeStore(folder, dict[str, Any])
        self._name, self._count = f"{identity}-{part}", 0

    @property
    def outcome(self) -> dict[str, Any]:
        """The finished result of the part; empty until it is finished."""
        return self._store.outcome(self._name) or {}

    def finish(self, outcome: dict[str, Any]) -> None:
        """Keep the result of the whole part, and delete the files of its solves."""
        self._store.keep(self._name, outcome)
        for file in self._store.folder.glob(f"{self._name}-*.json"):
            file.unlink(missing_ok=True)

    def recorded(self, solve: Callable[[], BoundaryPoint | str]) -> BoundaryPoint | str:
        """Return the result of the next solve: stored, or computed by `solve` and kept.

        A result is a point of the boundary, or the reason why there is none.
        """
        # solves come in the same order when a part is repeated, so a number identifies one
        name = f"{self._name}-{self._count:04d}"
        self._count += 1
        if (saved := self._store.outcome(name)) is not None:
            return _locus(saved) if "state" in saved else str(saved["reason"])
        solved = solve()
        self._store.keep(name, {"reason": solved} if isinstance(solved, str) else _as_data(solved))
        return solved


def text_of(v: Vector) -> str:
    """Return a vector as text that has its bytes (base 64), so that nothing is rounded."""
    return base64.b64encode(np.ascontiguousarray(v).tobytes()).decode()


def vector_of(text: str) -> Vector:
    """Return the vector that `text_of` has written."""
    return np.frombuffer(base64.b64decode(text)).copy()


def _as_data(locus: BoundaryPoint) -> dict[str, Any]:
    """Return a point of the boundary as plain data, with vectors as text."""
    data = {attribute.name: getattr(locus, attribute.name) for attribute in fields(locus)}
    state = {"u": text_of(locus.state.u), "mu": locus.state.mu}
    tangent = {"du": text_of(locus.way.du), "dmu": locus.way.dmu, "dp": locus.way.dp}
    return data | {"state": state, "way": tangent, "phi": text_of(locus.phi)}


def _locus(data: dict[str, Any]) -> BoundaryPoint:
    """Return the point of the boundary from the plain data of `_as_data`."""
    state = State(vector_of(data["state"]["u"]), data["state"]["mu"])
    tangent = CurveVector(vector_of(data["way"]["du"]), data["way"]["dmu"], data["way"]["dp"])
    return BoundaryPoint(**{**data, "state": state, "way": tangent, "phi": vector_of(data["phi"])})
