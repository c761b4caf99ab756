"""Thin magneto-elastic shells on FEniCSx: deformation, indentation, buckling.

>>> import magshell_fenicsx as ms
>>> case = ms.Case.load("cases/dimple_buckling.yaml")  # doctest: +SKIP
>>> ms.run(case).knockdown  # doctest: +SKIP
0.32624

Without a case file, `Problem` is made of a `Shell`, on a dolfinx mesh for instance, and of what
holds and loads it. A `Model` has its residual, tangent and mass at any state; `follow` (the history
of its case) and `trace` (a path in any amplitude) step through it; `gradient` differentiates what
was found by amplitudes, numbers of the case and fields; `columns`, `surface`, `polydata`, `curve`
and `picture` show what was found; an `OwnTerm` is one's own energy, whose `Free` parameters are
amplitudes too.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from magshell_fenicsx.platform.packages import load_mpi_first
from magshell_fenicsx.platform.version import __version__

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case
    from magshell_fenicsx.input.source import CaseError
    from magshell_fenicsx.mesh.patch import MeshError
    from magshell_fenicsx.model import Mode, Model
    from magshell_fenicsx.models.shell import kinematics
    from magshell_fenicsx.models.shell.kinematics import Jet as Jet
    from magshell_fenicsx.models.shell.own_term import Free, OwnTerm
    from magshell_fenicsx.public import Scene as Scene
    from magshell_fenicsx.public import boundary, ensemble, follow, identify, run, sweep
    from magshell_fenicsx.python import (
        Clamped,
        Field,
        Force,
        Held,
        Hinged,
        OnPlane,
        Pressure,
        Problem,
        Section,
        Shell,
        Step,
    )
    from magshell_fenicsx.runs.notebook import curve, off_screen, picture, polydata, surface
    from magshell_fenicsx.runs.rows import Table, columns
    from magshell_fenicsx.runs.summary import Result
    from magshell_fenicsx.simulate.gradients.gradient import gradient
    from magshell_fenicsx.simulate.record import Record, Stopped
    from magshell_fenicsx.simulate.search import solutions as solutions
    from magshell_fenicsx.simulate.sensitivity import sensitivities as sensitivities
    from magshell_fenicsx.simulate.steps import fold_at as fold_at
    from magshell_fenicsx.simulate.trace import trace

__all__ = [
    "Case",
    "CaseError",
    "Clamped",
    "Field",
    "Force",
    "Free",
    "Held",
    "Hinged",
    "MeshError",
    "Mode",
    "Model",
    "OnPlane",
    "OwnTerm",
    "Pressure",
    "Problem",
    "Record",
    "Result",
    "Section",
    "Shell",
    "Step",
    "Stopped",
    "Table",
    "__version__",
    "boundary",
    "columns",
    "curve",
    "ensemble",
    "follow",
    "gradient",
    "identify",
    "kinematics",
    "off_screen",
    "picture",
    "polydata",
    "run",
    "surface",
    "sweep",
    "trace",
]

_NAMES_OF_MODULES = {
    "case.case": "Case",
    "input.source": "CaseError",
    "mesh.patch": "MeshError",
    "models.shell": "kinematics",
    "models.shell.kinematics": "Jet",
    "models.shell.own_term": "Free OwnTerm",
    "model": "Mode Model",
    "public": "Scene boundary ensemble follow identify run sweep",
    "python": "Clamped Field Force Held Hinged OnPlane Pressure Problem Section Shell Step",
    "runs.notebook": "curve off_screen picture polydata surface",
    "runs.rows": "Table columns",
    "runs.summary": "Result",
    "simulate.gradients.gradient": "gradient",
    "simulate.record": "Record Stopped",
    "simulate.search": "solutions",
    "simulate.sensitivity": "sensitivities",
    "simulate.steps": "fold_at",
    "simulate.trace": "trace",
}
_MODULE_OF_NAME = {
    name: f"{__name__}.{module}"
    for module, names in _NAMES_OF_MODULES.items()
    for name in names.split()
}

load_mpi_first()


def __getattr__(name: str) -> Any:
    """Return a public name, imported when it is asked for: dolfinx takes long."""
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"{__name__}.{name}")
    module = import_module(_MODULE_OF_NAME[name])
    return getattr(module, name, None) or import_module(f"{_MODULE_OF_NAME[name]}.{name}")


def __dir__() -> list[str]:
    """Return the public names alone."""
    return sorted(__all__)
