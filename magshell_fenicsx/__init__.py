"""Thin magneto-elastic shells on FEniCSx: deformation, indentation, buckling.

>>> import magshell_fenicsx as ms
>>> case = ms.Case.load("cases/dimple_buckling.yaml")  # doctest: +SKIP
>>> ms.run(case).knockdown  # doctest: +SKIP
0.32624

A scene is stepped through by `follow` (the history of its case) and `trace` (a path in any amplitude); `columns`,
`surface`, `polydata`, `curve` and `picture` show what was found; an `OwnTerm` is one's own energy,
whose `Free` parameters are amplitudes too.
"""

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.models.shell import kinematics
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import Free, OwnTerm
from magshell_fenicsx.platform.version import __version__
from magshell_fenicsx.run.notebook import curve, picture, polydata, surface
from magshell_fenicsx.run.rows import columns
from magshell_fenicsx.run.run import Result, run
from magshell_fenicsx.simulate.follow import Record, Stopped, follow
from magshell_fenicsx.simulate.scene import Scene
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
    "kinematics",
    "picture",
    "polydata",
    "run",
    "sensitivities",
    "surface",
    "trace",
]
