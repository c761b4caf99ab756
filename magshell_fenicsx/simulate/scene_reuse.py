"""Reuse of a scene for a problem with other fields: nothing is meshed or compiled again.

A scene serves another problem whose remanence, thickness or natural curvature alone differ: their
coefficients get new values.
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

# section -> keys of the fields that a scene can take from another problem
FIELD_KEYS = {"magnetic": {"remanent"}, "shell": {"thickness_factor"}, "natural": {"curvature"}}


@dataclass
class SceneReuse:
    """Keeper of the latest scene, which serves the next problem if it can.

    Attributes
    ----------
    scene
        The latest scene; None before the first one.
    """

    scene: Scene | None = None

    def scene_for(self, problem: Problem, comm: MPI.Comm) -> Scene:
        """Return the scene of a problem, the latest one with new fields where possible; collective.

        Raises
        ------
        MeshError
            If the scene cannot be made.
        """
        scene, self.scene = self.scene, None
        if scene is None or not update_fields(scene, problem):
            scene = Scene(problem, comm)
        self.scene = scene
        return scene


def update_fields(scene: Scene, problem: Problem) -> bool:
    """Give a scene the remanence, thickness and natural curvature of a problem; collective.

    Returns
    -------
    bool
        Whether the problem differs in these alone and the scene has them as fields; if not, the
        scene stays as it is.

    Raises
    ------
    MeshError
        If a field has no fit value somewhere; the scene is unfit then.
    """
    model, old = scene.model, scene.problem
    has_same_data = _data_without_fields(old) == _data_without_fields(problem)
    # without data, as of a problem that a program has made, nothing can be compared
    if not (old.document.data and has_same_data):
        return False
    # solids, and models with contacts or dead loads, are always built anew
    if not model.thin or old.loads.dead:
        return False
    if model.contacts or model.shell_contacts:
        return False
    old_symmetry, new_symmetry = (
        (each.axisymmetric, each.mirror, each.azimuth) for each in (old, problem)
    )
    if old_symmetry != new_symmetry or _kinds_of_fields(problem) != _kinds_of_fields(old):
        return False
    if _has_fields_by_patch(problem) or _has_fields_by_patch(old):
        return False
    _set_fields(model, problem)
    model.loads = problem.loads
    scene.problem = problem
    # without what was known of the old fields: factors, and the state of the monitor
    scene.newton = BorderedNewton(model.system, scene.newton.options)
    scene.__dict__.pop("stability_monitor", None)
    return True


def _data_without_fields(problem: Problem) -> dict[str, Any]:
    """Return the data of a problem's case, key by key, without the fields that a scene can take."""
    return {
        key: _section_without_fields(key, section) for key, section in problem.document.data.items()
    }


def _section_without_fields(key: str, section: Any) -> Any:
    """Return the data of the section `key` without the fields that a scene can take."""
    if key not in FIELD_KEYS:
        return section
    return {name: value for name, value in section.items() if name not in FIELD_KEYS[key]}


def _kinds_of_fields(problem: Problem) -> tuple[bool | str | float, ...]:
    """Return which fields the terms of a problem have, to be compared with another problem.

    They are flags of remanence and thickness, the scale of a soft material (0.0 without one), and
    the amplitudes of the natural shape.
    """
    magnetic, natural = problem.loads.magnetic, problem.loads.natural
    amplitudes = natural.amplitudes if natural else ()
    soft_scale = magnetic.soft.scale if magnetic and magnetic.soft else 0.0
    has_remanence = callable(magnetic and magnetic.remanent)
    return has_remanence, problem.thickness is not None, soft_scale, *amplitudes


def _has_fields_by_patch(problem: Problem) -> bool:
    """Return whether a field of a problem is given by patches of a mesh."""
    magnetic, natural, thickness = problem.loads.magnetic, problem.loads.natural, problem.thickness
    has_natural_patches = natural is not None and any(
        isinstance(field, Mapping) for field in (natural.curvature, natural.stretch)
    )
    magnetic_patches = magnetic and magnetic.patches
    thickness_patches = thickness and thickness.patches
    return has_natural_patches or bool(magnetic_patches or thickness_patches)


def _set_fields(model: "ShellModel | MeridianModel", problem: Problem) -> None:
    """Put the fields of a problem into the coefficients of a model; collective."""
    magnetic, natural, r0 = problem.loads.magnetic, problem.loads.natural, model.r0
    # name -> coefficient of the terms' forms
    coefficients = {
        coefficient.name: coefficient
        for term in model.system.terms
        if isinstance(term, FormTerm)
        for coefficient in term.form.coefficients()
    }
    if magnetic and callable(magnetic.remanent):
        remanence, *_ = spatial_fields.pattern_field(magnetic.remanent, r0)
        coefficients["Br"].x.array[:] = remanence.x.array
    if problem.thickness and model.thickness:
        patches = model.midsurface.patches if model.midsurface else {}
        model.thickness.x.array[:] = thickness_field(problem.thickness, r0, patches).x.array
    if natural:
        curvature = natural_field(natural, spatial_fields.cell_geometry(r0), model.V)
        coefficients["natural"].x.array[:] = curvature.x.array
