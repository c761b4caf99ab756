"""Thin magneto-elastic shells on FEniCSx: deformation, indentation, buckling.

>>> import magshell_fenicsx as ms
>>> case = ms.Case.load("cases/dimple_buckling.yaml")  # doctest: +SKIP
>>> ms.run(case).knockdown  # doctest: +SKIP
0.32624

A scene is stepped through by `follow` (the history of its case) and `trace` (a path in any amplitude); `columns`,
`surface`, `polydata`, `curve` and `picture` show what was found; an `OwnTerm` is one's own energy.
"""

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.follow import Record, Stopped, follow
from magshell_fenicsx.notebook import curve, picture, polydata, surface
from magshell_fenicsx.rows import columns
from magshell_fenicsx.run import Result, run
from magshell_fenicsx.scene import Scene
from magshell_fenicsx.sensitivity import fold_at, sensitivities
from magshell_fenicsx.shell import kinematics
from magshell_fenicsx.shell.kinematics import Jet
from magshell_fenicsx.shell.own_term import OwnTerm
from magshell_fenicsx.trace import trace
from magshell_fenicsx.version import __version__

__all__ = [
    "Case",
    "CaseError",
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
