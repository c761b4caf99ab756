"""A source of the applied field as a load: its place, its angle or its strength changes.

A step is an entry of the programme, the list of loads that are applied one after the other. Its
amplitude is its load parameter, here the factor of the motion or of the change of strength; the
conjugate, -dPi/dmu, is the quantity on which it does work. `loads.magnetic.driven` are the fields
of sources that amplitudes drive: `motions` (translations and rotations) and `factors` (amplitude ->
change of the field's factor). `turns` are rotations of the whole field, which belong to another
kind of step. Pi is in E h R², lengths are over R.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from magshell_fenicsx.input.section import AboutAxis, Lengths, Name
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.magnetism.field_step import FieldSection
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection
from magshell_fenicsx.parts.observables import ModelView, Observables
from magshell_fenicsx.parts.path_step import Count, LoadStep
from magshell_fenicsx.parts.step_course import LoadStart, Target
from magshell_fenicsx.quantities.quantity import DISTANCE, FORCE, TORQUE, TURN, WORK, Quantity
from magshell_fenicsx.quantities.registry import QUANTITIES, RESERVED_NAMES

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.mesh.patch import PatchMesh
    from magshell_fenicsx.parts.loads import Loads


class SpinSection(AboutAxis):
    """A rotation of a source about an axis through its position, wherever that is."""


class SourceStep(LoadStep):
    """A source moves, turns or becomes stronger, in proportion to a factor.

    Its conjugate is the force of the shell on the source along the motion, the torque about the
    axis, or, of the strength, minus the derivative of the energy by it. Later steps may drive the
    same source again, from where it is then. The field must be there: a step of kind: field before,
    in a list of steps.
    """

    conjugate: ClassVar[str] = "force on the source"
    targets: ClassVar[dict[str, Target]] = {"factor": Target("load", "source")}
    kind: Literal["source"]
    name: Name = "source"
    """Name of the factor, which is its column in path.csv"""
    source: int | str = 0
    """Name of the source, or its number in magnetic.applied.sources, from 0"""
    move: Lengths | None = None
    """Translation for a factor of one [m]"""
    to: Lengths | None = None
    """The same by its end: the position for a factor of one, of a source that no other step moves
    [m]"""
    turn: SpinSection | None = None
    """Rotation for a factor of one"""
    strength: float | None = Field(default=None, ge=-1e6, le=1e6)
    """Factor of the field for a factor of one, from 1"""
    factor: float | None = Field(default=None, ge=-1e9, le=1e9)
    """Target of the factor, 1 by default"""
    points: Count = 10

    @model_validator(mode="after")
    def _one_change(self) -> Self:
        """Refuse a step without exactly one change, or with a name that is taken.

        Pydantic calls it after the fields are read; it raises a ValueError.
        """
        # keys that are given
        changes = [
            key for key in ("move", "to", "turn", "strength") if getattr(self, key) is not None
        ]
        if len(changes) != 1:
            raise ValueError("give one of move, to, turn and strength")
        has_zero_move = bool(self.move) and not any(self.move or [])
        if self.strength == 1 or has_zero_move:
            raise ValueError(f"{changes[0]}: changes nothing")
        if self.name in ({*RESERVED_NAMES, *QUANTITIES} - {"source"}):
            raise ValueError(
                f"name: {self.name}: is taken; choose another name for the factor of the source"
            )
        return self

    @property
    def amplitude(self) -> str:  # type: ignore[override]  # each has a name of its own
        return self.name

    @property
    def place(self) -> Any:
        """What tells one step of kind source from another: the source and its change."""
        return self.source, self.move, self.to, self.turn, self.strength

    @property
    def _end(self) -> float | None:
        return 1.0

    def scale(self, load_start: LoadStart) -> float:
        return abs(self.factor or 1.0)

    def number(self, sources: Sequence[SourceSection]) -> int | None:
        """Return the number of the step's source in the list; None if there is no such source."""
        if isinstance(self.source, int):
            return self.source if 0 <= self.source < len(sources) else None
        return next((i for i, source in enumerate(sources) if source.name == self.source), None)

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a step that does not fit the case, with a ValueError.

        It needs its source, a field that was applied before, and no other motion of the same source
        with `to`.
        """
        magnetic, key = context.section_of(MagneticSection), context.step.key
        sources = (magnetic.applied.sources if magnetic else None) or []
        if self.number(sources) is None:
            names = [source.name or str(i) for i, source in enumerate(sources)]
            raise ValueError(
                f"{key}.source: {self.source}: magnetic.applied.sources has no such source; "
                f"allowed: {', '.join(names) or 'none'}"
            )
        is_programme, field_amplitude = context.is_programme, FieldSection.amplitude
        if is_programme and field_amplitude not in context.driven_before(context.step.number):
            raise ValueError(
                f"{key}.kind: source needs the field of its source: a step of kind: field before it"
            )
        other_steps = (other for other in context.steps if other.name != context.step.name)
        other_loads = [other.load for other in other_steps if isinstance(other.load, SourceStep)]
        loads_of_same_source = (
            load for load in other_loads if load.number(sources) == self.number(sources)
        )
        if self.to and any(load.move or load.to for load in loads_of_same_source):
            raise ValueError(f"{key}.to: another step moves the same source: give move")


def source_columns(loads: "Loads") -> dict[str, str]:
    """Return amplitude of a source -> column of its conjugate.

    The conjugate is a force, a torque or a work: "source_force", "source_torque" or "source_work".
    Where several amplitudes have one kind, their names are appended to the columns.
    """
    kinds_of: dict[str, str] = {}
    # rotations of the whole field move every source, but are no step of kind source
    turns = [motion.name for motion in loads.magnetic.turns] if loads.magnetic else []
    for field in loads.magnetic.driven if loads.magnetic else ():
        own_motions = [motion for motion in field.motions if motion.name not in turns]
        kinds_of |= {
            motion.name: "source_torque" if motion.turns else "source_force"
            for motion in own_motions
        }
        kinds_of |= dict.fromkeys(field.factors, "source_work")
    kinds = list(kinds_of.values())
    return {
        name: kind if kinds.count(kind) == 1 else f"{kind}_{name}"
        for name, kind in kinds_of.items()
    }


def source_size(loads: "Loads", name: str) -> float:
    """Return the change of a source at an amplitude of one.

    It is a length over R, an angle in radians, or the change of the field's factor.

    Raises
    ------
    KeyError
        If no source has the amplitude `name`.
    """
    assert loads.magnetic
    for field in loads.magnetic.driven:
        if name in field.factors:
            return field.factors[name]
        for motion in field.motions:
            if motion.name == name:
                way = motion.turn if motion.turns else motion.shift
                return float(np.linalg.norm(way))
    raise KeyError(name)


class SourcesObservables(Observables):
    """Observables of driven sources: their amplitudes, and their conjugates in SI units."""

    quantities = (
        Quantity(
            "source",
            "source",
            "Factor of a source's motion or strength; the step may give it another name. With "
            "units the way of a motion has a column too, in mm or degrees.",
            "load",
            units=(DISTANCE, TURN),
        ),
        Quantity(
            "source_force",
            "force on the source",
            "Force of the shell on a source that is driven, along its motion; of several "
            "source_force_NAME.",
            "reaction",
            units=(FORCE,),
            each=True,
        ),
        Quantity(
            "source_torque",
            "torque on the source",
            "The same about the axis of its turn.",
            "reaction",
            units=(TORQUE,),
            each=True,
        ),
        Quantity(
            "source_work",
            "work of the source",
            "The same of its strength: -dΠ/d(factor of the field).",
            "reaction",
            units=(WORK,),
            each=True,
        ),
    )

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Refuse patches of a remanence that the surface does not have.

        Raises
        ------
        MeshError
            With the name of the patch.
        """
        # the solver takes long to import
        from magshell_fenicsx.models.shell.spatial_fields import by_patch

        if loads.magnetic and loads.magnetic.patches:
            # called for its check alone
            by_patch(loads.magnetic.patches, surface.patches, len(surface.cells))

    def amplitudes(self, loads: "Loads") -> tuple[str, ...]:
        return tuple(source_columns(loads))

    def conjugates(self, loads: "Loads") -> dict[str, str]:
        return source_columns(loads)

    def motions(self, loads: "Loads") -> dict[str, tuple[bool, float]]:
        """Return amplitude of a motion -> whether it turns, and its way at an amplitude of one.

        The way is over R or in radians.
        """
        motions = [
            motion
            for field in (loads.magnetic.driven if loads.magnetic else ())
            for motion in field.motions
        ]
        return {
            motion.name: (bool(motion.turns), source_size(loads, motion.name)) for motion in motions
        }

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return the amplitudes of sources and their conjugates in SI units, column -> value."""
        values_by_column: dict[str, float] = {}
        for name, column in source_columns(view.loads).items():
            values_by_column |= {
                name: state.mu[name],
                column: -view.potential(state, name) / self._unit(view, name),
            }
        return values_by_column

    def conjugate_unit(self, view: ModelView, name: str) -> float | None:
        """Return -dPi/dmu, in E h R², at which a source's conjugate is 1 N, 1 N m or 1 J.

        None for other amplitudes.
        """
        return self._unit(view, name) if name in self.amplitudes(view.loads) else None

    def _unit(self, view: ModelView, name: str) -> float:
        """Return -dPi/dmu, in E h R², at which the conjugate of `name` is 1 N, 1 N m or 1 J.

        -dPi/dmu is the conjugate times the source's change at an amplitude of one. The model has
        one of `multiplicity` equal parts of the shell.
        """
        # a force needs a length to be an energy, a torque or a work does not
        arm = 1.0 if source_columns(view.loads)[name].startswith("source_force") else view.length
        return source_size(view.loads, name) / (view.force * arm * view.model.multiplicity)
