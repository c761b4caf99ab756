"""The kinds of steps, and the programme of a case: its steps with their numbers and amplitudes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

from pydantic import Discriminator, Field, Tag

from magshell_fenicsx.input.chosen import Chosen
from magshell_fenicsx.parts.bodies.press import ContactSection
from magshell_fenicsx.parts.forces.dead import DeadSection
from magshell_fenicsx.parts.forces.indentation import IndentationSection
from magshell_fenicsx.parts.imperfections.growth import ImperfectionStep
from magshell_fenicsx.parts.magnetism.field_step import FieldBefore, FieldSection, RotationSection
from magshell_fenicsx.parts.magnetism.source_step import SourceStep
from magshell_fenicsx.parts.motion.step import TimeSection
from magshell_fenicsx.parts.natural.growth import GrowthSection
from magshell_fenicsx.parts.pressure.pressure import PressureSection
from magshell_fenicsx.parts.step import PathStep, Step, Until
from magshell_fenicsx.parts.supports.motion import EdgeSection

OneStep: TypeAlias = Annotated[
    PressureSection
    | IndentationSection
    | FieldSection
    | RotationSection
    | GrowthSection
    | ImperfectionStep
    | DeadSection
    | EdgeSection
    | ContactSection
    | SourceStep
    | TimeSection,
    Chosen("kind"),
]
PROGRAMME = "programme"  # tag of a list of steps
Loading: TypeAlias = Annotated[
    Annotated[OneStep, Tag("one")] | Annotated[list[OneStep], Tag(PROGRAMME), Field(min_length=1, max_length=1000)],
    Discriminator(lambda data: PROGRAMME if isinstance(data, list) else "one"),
]


@dataclass(frozen=True)
class ProgrammeStep:
    """A step of a programme.

    Attributes
    ----------
    number
        From 1.
    name
        Name of its amplitude; a second force or list of dead loads has a number, such as "force_2".
    key
        Where it is in the case file.
    """

    number: int
    name: str
    key: str
    load: Step

    @property
    def kind(self) -> str:
        return str(getattr(self.load, "kind", ""))

    @property
    def until(self) -> Until:
        return self.load.until if isinstance(self.load, PathStep) else "target"


def programme(
    loading: Step | Sequence[Step] | None,
    *,
    field: bool,
    natural: Sequence[str] = (),
    approaches: Mapping[str, str] | None = None,
) -> tuple[ProgrammeStep, ...]:
    """The steps of a case: those of a list, or the natural shape, the field and then one load.

    Parameters
    ----------
    field
        Whether the case has a field.
    natural
        What of its natural shape grows, stretch before curvature.
    approaches
        Body -> name of its approach.
    """
    if isinstance(loading, Sequence):
        return _numbered(loading, [f"loading.{i}" for i in range(len(loading))], approaches or {})
    grown = [] if isinstance(loading, GrowthSection) else [{"kind": "natural", key: 1.0} for key in natural]
    growth = [GrowthSection.model_validate(each) for each in grown]
    drives = isinstance(loading, FieldSection) or (isinstance(loading, TimeSection) and "field" in loading.history)
    first = [FieldBefore(kind="field")] if field and not drives else []
    given = [loading] if loading else []
    keys = [*("natural" for _ in growth), *("magnetic" for _ in first), *("loading" for _ in given)]
    return _numbered([*growth, *first, *given], keys, approaches or {})


def _numbered(loads: Sequence[Step], keys: Sequence[str], approaches: Mapping[str, str]) -> tuple[ProgrammeStep, ...]:
    known: dict[str, list[Any]] = {}
    steps = []
    for number, (load, key) in enumerate(zip(loads, keys, strict=True), 1):
        if isinstance(load, ContactSection):
            body = str(load.body or next(iter(approaches), ""))
            steps.append(ProgrammeStep(number, approaches.get(body, load.amplitude), key, load))
            continue
        places = known.setdefault(load.amplitude, [])
        if load.place not in places:
            places.append(load.place)
        which = places.index(load.place) + 1
        steps.append(ProgrammeStep(number, load.amplitude + (f"_{which}" if which > 1 else ""), key, load))
    return tuple(steps)
