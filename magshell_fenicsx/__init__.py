"""Thin magneto-elastic shells on FEniCSx: deformation, indentation, buckling.

>>> import magshell_fenicsx as ms
>>> case = ms.Case.load("cases/dimple_buckling.yaml")  # doctest: +SKIP
>>> ms.run(case).knockdown  # doctest: +SKIP
0.32624

A scene is stepped through by `follow` (the history of its case) and `trace` (a path in any amplitude); `gradient`
differentiates what was found by amplitudes, numbers of the case and fields; `columns`,
`surface`, `polydata`, `curve` and `picture` show what was found; an `OwnTerm` is one's own energy,
whose `Free` parameters are amplitudes too.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from magshell_fenicsx.platform.version import __version__

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case
    from magshell_fenicsx.input.source import CaseError
    from magshell_fenicsx.models.shell import kinematics
    from magshell_fenicsx.models.shell.kinematics import Jet
    from magshell_fenicsx.models.shell.own_term import Free, OwnTerm
    from magshell_fenicsx.runs.notebook import curve, picture, polydata, surface
    from magshell_fenicsx.runs.rows import columns
    from magshell_fenicsx.runs.run import Result, run
    from magshell_fenicsx.simulate.follow import follow
    from magshell_fenicsx.simulate.gradients.gradient import gradient
    from magshell_fenicsx.simulate.record import Record, Stopped
    from magshell_fenicsx.simulate.scene import Scene
    from magshell_fenicsx.simulate.search import solutions
    from magshell_fenicsx.simulate.sensitivity import fold_at, sensitivities
    from magshell_fenicsx.simulate.trace import trace

__all__ = [
    "Case",
    "CaseError",
    "Free",
    "Jet",
    "OwnTerm",
    "Record",
    "Result",
    "Scene",
    "Stopped",
    "__version__",
    "columns",
    "curve",
    "fold_at",
    "follow",
    "gradient",
    "kinematics",
    "picture",
    "polydata",
    "run",
    "sensitivities",
    "solutions",
    "surface",
    "trace",
]

_ROOMS = {
    "case.case": "Case",
    "input.source": "CaseError",
    "models.shell": "kinematics",
    "models.shell.kinematics": "Jet",
    "models.shell.own_term": "Free OwnTerm",
    "runs.notebook": "curve picture polydata surface",
    "runs.rows": "columns",
    "runs.run": "Result run",
    "simulate.follow": "follow",
    "simulate.gradients.gradient": "gradient",
    "simulate.record": "Record Stopped",
    "simulate.scene": "Scene",
    "simulate.search": "solutions",
    "simulate.sensitivity": "fold_at sensitivities",
    "simulate.trace": "trace",
}
_WHERE = {name: f"{__name__}.{room}" for room, names in _ROOMS.items() for name in names.split()}


def __getattr__(name: str) -> Any:
    """A public name, imported when it is asked for: dolfinx takes long."""
    if name not in _WHERE:
        raise AttributeError(f"{__name__}.{name}")
    room = import_module(_WHERE[name])
    return getattr(room, name, None) or import_module(f"{_WHERE[name]}.{name}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
