"""Thin magneto-elastic shells on FEniCSx: deformation, indentation, buckling.

>>> import magshell_fenicsx as ms
>>> case = ms.Case.load("cases/dimple_buckling.yaml")  # doctest: +SKIP
>>> ms.run(case).knockdown  # doctest: +SKIP
0.32624
"""

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.follow import Record, Stopped, follow
from magshell_fenicsx.run import Result, run
from magshell_fenicsx.scene import Scene
from magshell_fenicsx.version import __version__

__all__ = ["Case", "CaseError", "Record", "Result", "Scene", "Stopped", "__version__", "follow", "run"]
