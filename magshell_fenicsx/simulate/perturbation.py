"""A scene with another number of its problem, on the same mesh: for derivatives by differences.

The problem is the one that a file with this number would give: lengths with units stay, those over
h or in the unit of a dimple's width change with these.
"""

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.section import is_length
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.imperfections.imperfection import LocalSection
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.problem.requests import GRADIENT_FIELDS
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
MATERIAL_KEYS = (
    "alpha",
    "density",
    "laminate",
    "mooney",
    "mu",
    "poisson_ratio",
    "radius_to_thickness",
    "thickness",
    "youngs_modulus",
    "thickness_factor",
)
DEVIATION_KEYS = ("imperfections", "defect")
KEYS_OUTSIDE_THE_MODEL = (
    "mesh",
    "stability",
    "frequencies",
    "gradients",
    "ensemble",
    "design",
    "identify",
    "output",
)
KEYS_WITHOUT_GRADIENT = (*KEYS_OUTSIDE_THE_MODEL, "loading", "points", "boundary")


def number_at_key(context: Context, key: str) -> float:
    """The number at a key such as "magnetic.remanent.polar".

    Raises
    ------
    CaseError
        If there is no number, or one that changes the mesh, a target or the modes of the perfect
        shell.
    """
    part, _ = _value_and_kind(context, key)
    if isinstance(part, bool) or not isinstance(part, int | float):
        raise CaseError(f"{key}: is no number that the case gives: {part!r}")
    if isinstance(part, int):
        raise CaseError(f"{key}: is a whole number: it has no gradient")
    if key.startswith("magnetic.remanent.layers.") and key.endswith(".fraction"):
        raise CaseError(
            f"{key}: the fractions of the layers add up to 1: one alone has no gradient"
        )
    if key.startswith("shell.laminate.plies.") and key.endswith(".fraction"):
        raise CaseError(f"{key}: the fractions of the plies add up to 1: one alone has no gradient")
    own_key = (
        key.split(".", 2)[2] if key.startswith("shells.") else key
    )  # of one of several shells, in its own section
    section, _, rest = own_key.partition(".")
    geometry = section == "shell" and rest.split(".")[0] not in (*MATERIAL_KEYS, *DEVIATION_KEYS)
    if section in KEYS_WITHOUT_GRADIENT or geometry:
        raise CaseError(
            f"{key}: a number of the mesh, of the shape, of a target or of the output has no gradient here"
        )
    flaws = [*(context.sections.get("imperfections") or {}).values()]
    flaws += [
        flaw
        for section in (context.sections.get("shells") or {}).values()
        for flaw in section.shell.imperfections
    ]
    if any(flaw.of_perfect_shell for flaw in flaws) and ".imperfections." not in key:
        raise CaseError(
            f"{key}: the modes of the perfect shell, which the case has as imperfections, change with it: give their "
            "file (kind: modes, file)"
        )
    return float(part)


def scale_at_key(context: Context, key: str) -> float:
    """What a change of the number at a key is small against.

    The number itself; of a zero the largest number of its list, of a zero length R in the case's
    unit, else one.
    """
    value, is_a_length = _value_and_kind(context, key)
    neighbours, _ = _value_and_kind(context, key.rpartition(".")[0])
    numbers = (
        [v for v in neighbours if isinstance(v, float | int)]
        if isinstance(neighbours, list)
        else []
    )
    return (
        abs(value)
        or max(map(abs, numbers), default=0.0)
        or (context.shell.reference if is_a_length else 1.0)
    )


def _value_and_kind(context: Context, key: str) -> tuple[Any, bool]:
    """What stands at a key, and whether it is a length by the type of its section.

    Raises
    ------
    CaseError
        If there is no such key.
    """
    part: Any = {
        name: section for name, section in context.sections.items() if name != "imperfections"
    }
    a_length = False
    for name in key.split("."):
        try:
            if isinstance(part, list):
                part = part[int(name)]
            elif isinstance(part, dict):
                part = part[name]
            else:
                field = type(part).model_fields[name]
                part, a_length = getattr(part, name), is_length(field.annotation, field.metadata)
        except (LookupError, ValueError, AttributeError):
            raise CaseError(f"{key}: the case has no such key ({name})") from None
    return part, a_length


def refuse_unknown_parameters(context: Context, names: Iterable[str], start: State) -> None:
    """See that gradients can be taken by fields, amplitudes and numbers with these names.

    Raises
    ------
    CaseError
        If one is none of the case.
    """
    try:
        for name in names:
            if name not in GRADIENT_FIELDS and name not in start.mu:
                number_at_key(context, name)
    except CaseError as e:
        raise CaseError(f"gradients.by: {e}") from None


def perturbed_scene(scene: Scene, key: str, value: float) -> Scene:
    """The scene with another number, on the same mesh; collective.

    Raises
    ------
    CaseError
        If the number breaks the symmetry by which only a part is modelled, or moves an edge of a
        patch.
    """
    old, new = scene.problem, scene.problem.with_values({key: value})
    if (old.axisymmetric, old.mirror, old.azimuth) != (new.axisymmetric, new.mirror, new.azimuth):
        raise CaseError(
            f"{key}: a change of it breaks the symmetry of the model: give the case symmetry: none"
        )
    if new.patched and _rims(new) != _rims(old):
        raise CaseError(
            f"{key}: moves the rim of a dimple, which is the edge of a patch in the mesh; a width with a unit "
            "depends on no other number"
        )
    return Scene(problem_on_mesh_of(scene, new), scene.comm)


def _rims(problem: Problem) -> list[object]:
    """Where the rims of patches are."""
    shell = problem.context.shell
    local = [
        section for section in problem.imperfections.values() if isinstance(section, LocalSection)
    ]
    return [
        (section.half_width(shell.R_over_h, shell.poisson_ratio), section.at)
        for section in local
        if section.patch
    ]


def problem_on_mesh_of(scene: Scene, new: Problem) -> Problem:
    """What a problem changes beside the mesh, for the mesh of a scene in its chart; imperfections
    change too.
    """
    old, model, meridian, shape = (
        scene.problem,
        scene.model,
        scene.problem.meridian,
        scene.problem.shape,
    )
    if model.midsurface:
        shape = model.midsurface.with_embedding(new.embedding)
    elif model.axisymmetric:
        assert new.meridian
        meridian = replace(new.meridian, vertices=np.sort(model.meridian.mesh.geometry.x[:, 0]))
    return replace(
        old,
        context=new.context,
        lambda_m=new.lambda_m,
        body=new.body,
        material=new.material,
        loads=new.loads,
        thickness=new.thickness,
        embedding=new.embedding,
        meridian=meridian,
        shape=shape,
    )


def state_with_new_loads(
    old: Scene, new: Scene, state: State, own_key: Collection[str] = (), steps: int | None = None
) -> State:
    """The state with the loads of the new scene: where its targets are other numbers, amplitudes
    are in proportion.

    Parameters
    ----------
    own
        Amplitudes that are results, or follow from what is held.
    steps
        How many steps of the programme led to the state; None: all.
    """
    ratios, fields = (
        target_ratios(old, new, "load", steps),
        [name for name in state.mu if name.startswith("lambda_")],
    )
    for contact, other in zip(old.problem.loads.contacts, new.problem.loads.contacts, strict=True):
        ratios[contact.setting] = other.stiffness / contact.stiffness
    old_values, new_values = (
        old.unloaded().mu,
        new.unloaded().mu,
    )  # stiffnesses of parts are amplitudes too
    ratios |= {
        name: new_values[name] / value
        for name, value in old_values.items()
        if value and name in new_values
    }
    if "lambda_m" in state.mu and new.problem.lambda_m != old.problem.lambda_m:
        if not old.problem.lambda_m:
            raise CaseError(
                "magnetic: a field of zero has no derivative by a number: take by: lambda_m"
            )
        ratios |= dict.fromkeys(fields, new.problem.lambda_m / old.problem.lambda_m)
    return State(
        state.u,
        {
            name: value * (1.0 if name in own_key else ratios.get(name, 1.0))
            for name, value in state.mu.items()
        },
    )


def target_ratios(
    old: Scene, new: Scene, quantity: str, steps: int | None = None
) -> dict[str, float]:
    """Amplitude -> target of the new scene over that of the old one, where they differ: those that
    have units.
    """
    targets = dict[str, float]()
    for step, new_step in zip(
        old.problem.programme[:steps], new.problem.programme[:steps], strict=True
    ):
        old_target, new_target = step.load.target, new_step.load.target
        if (
            old_target
            and new_target
            and old_target[0].quantity == quantity
            and old_target[1]
            and old_target[1] != new_target[1]
        ):
            targets[step.name] = new_target[1] / old_target[1]
    return targets


def same_chart_bounds(old_target: object, new_target: object) -> bool:
    """Whether two shapes have the same bounds of their charts, as far as these are known."""
    a, b = chart_bounds(old_target), chart_bounds(new_target)
    return (
        a is None
        or b is None
        or (np.allclose(a[0], b[0], 0, 1e-14) and np.allclose(a[1], b[1], 0, 1e-14))
    )


def chart_bounds(shape: object) -> tuple[Array, Array] | None:
    """Bounds of the chart of a shape; None if they are not known."""
    if isinstance(shape, Grid):
        return np.array(shape.low), np.array(shape.high)
    box: tuple[Array, Array] | None = getattr(shape, "box", None)
    radius = getattr(shape, "radius", None)
    return (np.zeros(2), np.full(2, radius)) if radius is not None else box
