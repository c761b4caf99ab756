"""A scene that stands, with the fields of another problem: nothing is meshed, compiled or made a
form again.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.models.shell import spatial_fields
from magshell_fenicsx.models.shell.thickness import thickness_field
from magshell_fenicsx.parts.natural.shape import natural_field
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.scene import Scene

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

FIELDS = {"magnetic": {"remanent"}, "shell": {"thickness_factor"}, "natural": {"curvature"}}


@dataclass
class Standing:
    """The scene of the problem before, to be used again."""

    scene: Scene | None = None

    def of(self, problem: Problem, comm: MPI.Comm) -> Scene:
        """The scene of a problem; collective.

        Raises
        ------
        MeshError
            If it cannot be made.
        """
        standing, self.scene = self.scene, None
        if standing is None or not refilled(standing, problem):
            standing = Scene(problem, comm)
        self.scene = standing
        return standing


def refilled(scene: Scene, problem: Problem) -> bool:
    """Give a scene the remanence, thickness and natural curvature of a problem; collective.

    Returns
    -------
    Whether they are all that differs and the scene has them as fields; otherwise it stays as it is.

    Raises
    ------
    MeshError
        If a field has no fit value somewhere; the scene is unfit then.
    """
    model, old = scene.model, scene.problem
    same = bool(old.document.data) and _apart_from_fields(old) == _apart_from_fields(problem)
    if not same or not model.thin or model.contacts or model.shell_contacts or old.loads.dead:
        return False
    if (old.axisymmetric, old.mirror, old.azimuth) != (
        problem.axisymmetric,
        problem.mirror,
        problem.azimuth,
    ):
        return False
    if _fields(problem) != _fields(old) or _patches(problem) or _patches(old):
        return False
    _put(model, problem)
    model.loads = problem.loads
    scene.problem = problem
    scene.newton = BorderedNewton(model.system, scene.newton.options)
    scene.__dict__.pop("watch", None)
    return True


def _apart_from_fields(problem: Problem) -> dict[str, Any]:
    """What was written of it, without what may be refilled."""
    return {
        key: {name: v for name, v in section.items() if name not in FIELDS[key]}
        if key in FIELDS
        else section
        for key, section in problem.document.data.items()
    }


def _fields(problem: Problem) -> tuple[bool | str | float, ...]:
    """Which there are in the terms."""
    magnetic, natural = problem.loads.magnetic, problem.loads.natural
    grown = natural.amplitudes if natural else ()
    soft = magnetic.soft.scale if magnetic and magnetic.soft else 0.0
    return callable(magnetic and magnetic.remanent), problem.thickness is not None, soft, *grown


def _patches(problem: Problem) -> bool:
    """Whether one is given by patches of a mesh."""
    magnetic, natural, thickness = problem.loads.magnetic, problem.loads.natural, problem.thickness
    drawn = natural is not None and any(
        isinstance(v, Mapping) for v in (natural.curvature, natural.stretch)
    )
    return drawn or bool((magnetic and magnetic.patches) or (thickness and thickness.patches))


def _put(model: "ShellModel | MeridianModel", problem: Problem) -> None:
    magnetic, natural, r0 = problem.loads.magnetic, problem.loads.natural, model.r0
    coefficients = {
        c.name: c
        for t in model.system.terms
        if isinstance(t, FormTerm)
        for c in t.form.coefficients()
    }
    if magnetic and callable(magnetic.remanent):
        coefficients["Br"].x.array[:] = spatial_fields.pattern_field(magnetic.remanent, r0)[0].x.array
    if problem.thickness and model.thickness:
        patches = model.midsurface.patches if model.midsurface else {}
        model.thickness.x.array[:] = thickness_field(problem.thickness, r0, patches).x.array
    if natural:
        coefficients["natural"].x.array[:] = natural_field(
            natural, spatial_fields.cells_of(r0), model.V
        ).x.array
