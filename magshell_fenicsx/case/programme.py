"""What the steps of a programme must have in common."""

from collections.abc import Collection, Sequence

from magshell_fenicsx.case.loading import ProgrammeStep
from magshell_fenicsx.parts.forces.dead import DeadSection
from magshell_fenicsx.parts.forces.indentation import IndentationSection
from magshell_fenicsx.parts.magnetism.field_step import FieldBefore, FieldSection, RotationSection
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.magnetism.source_step import SourceStep, refuse_unknown_source
from magshell_fenicsx.parts.motion.step import TimeSection, refuse_unfit_time
from magshell_fenicsx.parts.step import LEAST_TARGET, Gas, PathStep, Step
from magshell_fenicsx.parts.supports.motion import EdgeSection

SAME = 1e-9  # cosine of directions: rounding


def refuse_unfit_steps(
    steps: Sequence[ProgrammeStep],
    magnetic: MagneticSection | None,
    lambda_m: float,
    *,
    whole: bool,
    density: bool = False,
) -> None:
    """See that each step has its field, a way to go, and known amplitudes to hold.

    Parameters
    ----------
    whole
        Whether the steps are all that happens; otherwise the field is applied first.
    density
        Whether times may have units.

    Raises
    ------
    ValueError
        With the key and what is allowed.
    """
    driven: set[str] = set()
    amplitudes, moved = {step.name for step in steps}, {s.name for s in steps if isinstance(s.load, EdgeSection)}
    field = magnetic.applied.vector() if magnetic else None
    for step in steps:
        load, key = step.load, step.key
        if isinstance(load, FieldSection) and not isinstance(load, FieldBefore) and not lambda_m:
            raise ValueError(f"{key}.kind: field needs magnetic.lambda_m, not zero, for its target or direction")
        if isinstance(load, SourceStep):
            sources = magnetic.applied.sources if magnetic else None
            refuse_unknown_source(key, load, sources or [])
            if whole and "lambda_m" not in driven:
                raise ValueError(f"{key}.kind: source needs the field of its source: a step of kind: field before it")
            others = [other.load for other in steps if isinstance(other.load, SourceStep) and other.name != step.name]
            same = (other for other in others if other.number(sources or []) == load.number(sources or []))
            if load.to and any(other.move or other.to for other in same):
                raise ValueError(f"{key}.to: another step moves the same source: give move")
        if isinstance(load, RotationSection):
            if magnetic is None or field is None or not lambda_m:
                raise ValueError(f"{key}.kind: rotation needs a field: magnetic.lambda_m, not zero")
            if whole and "lambda_m" not in driven:
                raise ValueError(f"{key}.kind: rotation needs a field: a step of kind: field before it")
            if abs(field @ load.to.vector()) > 1 - SAME:
                where = "magnetic.applied" if "angle" not in driven else "the field at its beginning"
                raise ValueError(f"{key}.to: must be neither parallel nor opposite to {where}")
            field = load.to.vector()
        if step.name not in driven and load.target and load.target[1] == 0:
            raise ValueError(
                f"{key}: the target must not be zero (at least {LEAST_TARGET:g} in size): the first step of a load "
                "begins there"
            )
        after = steps[step.number - 2].load if step.number > 1 else None
        if isinstance(after, TimeSection) and after.until != "rest" and not isinstance(load, TimeSection):
            raise ValueError(f"{key}: begins in equilibrium: the step of kind: time before it needs until: rest")
        if isinstance(load, TimeSection):
            if "field" in load.history and (not lambda_m or "angle" in driven):
                why = "not after kind: rotation" if lambda_m else "needs magnetic.lambda_m, not zero"
                raise ValueError(f"{key}.history.field: {why}")
            flux = magnetic is not None and magnetic.applied.flux_density not in (None, 0.0)
            refuse_unfit_time(key, load, amplitudes, moved, density=density, measured=flux)
            driven.update(load.drives)
        driven.add(step.name)
        _refuse_unfit_hold(step, steps)


def refuse_unnamed(steps: Sequence[ProgrammeStep], points: Collection[str]) -> None:
    """See that each point at which something is loaded has a place.

    Raises
    ------
    ValueError
        With the key and the points that there are.
    """
    for step in steps:
        load, at = step.load, dict[str, str | None]()
        if isinstance(load, DeadSection):
            at = {f"loads.{i}.at": each.at for i, each in enumerate(load.loads)}
        elif isinstance(load, IndentationSection):
            at = {"at.point": load.at.point}
        for key, name in at.items():
            if name is not None and name not in points:
                known = ", ".join(points) or "none"
                raise ValueError(f"{step.key}.{key}: {name}: name it in points, with its place; there are {known}")


def _refuse_unfit_hold(step: ProgrammeStep, steps: Sequence[ProgrammeStep]) -> None:
    loads: dict[str, Step | None] = {"pressure": None, **{other.name: other.load for other in steps}}
    loads.pop("angle", None)
    if isinstance(step.load, TimeSection):
        loads.pop("time")
    limit = isinstance(step.load, PathStep) and step.load.until == "limit"
    allowed = sorted(set(loads) - (set() if limit else {step.name}))
    for name, how in step.load.hold.items():
        key = f"{step.key}.hold.{name}"
        if name == step.name and not (limit and how == "conjugate"):
            raise ValueError(f"{key}: this step drives {name}; allowed: {', '.join(allowed) or 'none'}")
        if name not in loads:
            raise ValueError(f"{key}: the programme has no such amplitude; allowed: {', '.join(allowed) or 'none'}")
        load = loads[name]
        if isinstance(how, Gas) and name != "pressure":
            raise ValueError(f"{key}: a gas holds the pressure, not {name}; allowed: load, conjugate")
        if (
            how == "conjugate"
            and load is not None
            and (not load.conjugate or (isinstance(load, DeadSection) and (load.turns or load.by_place)))
        ):
            raise ValueError(f"{key}: conjugate: nothing that can be held is conjugate to it; allowed: load")
        moves = isinstance(step.load, TimeSection) or getattr(step.load, "then", None)
        if how == "conjugate" and isinstance(load, EdgeSection) and moves:
            raise ValueError(f"{key}: conjugate: a support that is free to move has a mass, which is not known")
