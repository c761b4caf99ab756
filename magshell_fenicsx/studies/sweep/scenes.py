"""Scenes that the points of a sweep share on one rank: those that differ by the strength of the field alone."""

import json

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.scene import Scene

MOST = 200_000  # unknowns of all kept scenes: 1 GB with their factors


class Scenes:
    """The scenes of a rank; the ones that were used last are kept."""

    def __init__(self) -> None:
        self._kept: dict[str, Scene] = {}

    def of(self, case: Case) -> Scene:
        """The scene of a case, made anew if none is kept.

        Raises
        ------
        MeshError
            If it cannot be meshed.
        """
        key = _apart_from_strength(case)
        known = self._kept.pop(key, None)
        scene = known.retuned(case) if known else Scene(with_modes(case, MPI.COMM_SELF), MPI.COMM_SELF)
        self._kept[key] = scene
        while sum(each.newton.system.size for each in self._kept.values()) > MOST and len(self._kept) > 1:
            self._kept.pop(next(iter(self._kept)))
        return scene


def _apart_from_strength(case: Case) -> str:
    """What determines all of a scene but the size of lambda_m, which is an amplitude."""
    data = case.model_dump(mode="json") | case.outside
    if magnetic := data.get("magnetic"):
        magnetic.pop("lambda_m", None)
        magnetic["remanent"].pop("flux_density", None)
        if not case.sources:  # otherwise it is that of the field beside them
            magnetic["applied"].pop("flux_density", None)
    return json.dumps([data, bool(case.lambda_m)], sort_keys=True)
