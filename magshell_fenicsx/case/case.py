"""The whole case: its sections and what they must have in common.

An ability is a section that adds something to a problem, such as a field or a joint. The programme
is the sequence of load steps. A patch is a named part of the surface, a dimple an imperfection with
a rim. A case with `shells` is rewritten as a case of one mesh file with all of them; `several`
keeps them. R, h and E are reference length, thickness and Young's modulus. The origin of a case has
its plain data (the mapping in its file), and where each key stands in the file.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    ValidationInfo,
    model_serializer,
    model_validator,
)

from magshell_fenicsx.case.case_base import Origin, WithParts
from magshell_fenicsx.case.loading import (
    Loading,
    loads_by_key,
    programme,
    refuse_unfit_steps,
    refuse_unknown_patches,
)
from magshell_fenicsx.case.multi_shell_case import merge_shells, without_merged_keys
from magshell_fenicsx.case.shells import (
    MemberCase,
    OneOfShells,
    SeveralShells,
    Shells,
    in_words_of_shells,
)
from magshell_fenicsx.input.messages import InvalidCase
from magshell_fenicsx.input.section import (
    NOTED,
    ChosenByKey,
    FileKeys,
    LazyValidation,
    digests,
    numbers_with_units,
)
from magshell_fenicsx.input.source import Source, read_source
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.bodies.contact_step import approaches
from magshell_fenicsx.parts.contact.contact_section import Pairs
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection
from magshell_fenicsx.parts.joints import Joints
from magshell_fenicsx.parts.kinds import Bodies
from magshell_fenicsx.parts.magnetism.field_maps import FieldMaps
from magshell_fenicsx.parts.magnetism.fields import MagneticSection, strength
from magshell_fenicsx.parts.magnetism.remanent import RemanentSection
from magshell_fenicsx.parts.magnetism.sensors import Sensors
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection
from magshell_fenicsx.parts.natural.section import NaturalSection
from magshell_fenicsx.parts.registered import PART_CLASSES
from magshell_fenicsx.parts.revolution_sections import CapSurface, RevolutionSurface
from magshell_fenicsx.parts.shell_sections import MeshSurface, ShellSection, Surface
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.supports.boundary import BoundarySection
from magshell_fenicsx.problem.mesh_sizes import MeshSection, SolidSection
from magshell_fenicsx.problem.requests import (
    FrequenciesSection,
    GradientsSection,
    OutputSection,
    StabilitySection,
)
from magshell_fenicsx.shape.reference_shell import Coordinates
from magshell_fenicsx.studies.design.sections import DesignSection
from magshell_fenicsx.studies.ensemble.sections import EnsembleSection
from magshell_fenicsx.studies.identify.sections import IdentifySection

if TYPE_CHECKING:
    from magshell_fenicsx.problem.problem import Problem

Waves = Annotated[int, Field(ge=1, le=200)]
SECTIONS_WITH_SHELL_UNITS = (
    "mesh",
    "points",
    "sensors",
    "field_maps",
    "natural",
    "bodies",
    "joints",
    "loading",
    *PART_CLASSES,
)
"""Sections whose numbers have units where the shell's lengths have."""


class Case(WithParts):
    """A shell, what holds it, its field and its load; validated."""

    model: Literal["shell", "solid"] = "shell"
    """A thin shell, or its body in three dimensions"""
    shell: Annotated[ShellSection | Surface, ChosenByKey("geometry"), NOTED]
    """Mid-surface, thickness and material"""
    solid: SolidSection | None = None
    """Of `model: solid`"""
    boundary: BoundarySection
    """What is held"""
    points: dict[str, Coordinates] = Field(default_factory=dict)
    """Name -> place of what is loaded, held or watched [the shell's length; over R if that has no
    unit]"""
    shells: Shells | None = None
    """Name -> one of several shells, in place of `shell`, `boundary`, `points` and
    `magnetic.remanent`. Formulas and results are over the R, h, E and density of the first. The
    edge or point `rim` of the shell `upper` is `upper.rim` in a case and `upper_rim` in columns;
    the shell itself is the patch `upper`"""
    magnetic: Annotated[MagneticSection, LazyValidation(MagneticSection)] | None = None
    """Remanence and applied field, which is applied before the load"""
    sensors: Sensors = Field(default_factory=dict)
    """Name -> point at which the magnetic field is read"""
    field_maps: FieldMaps = Field(default_factory=dict)
    """Name -> grid on which the magnetic field is computed, for ParaView and drawn"""
    natural: Annotated[NaturalSection, LazyValidation(NaturalSection)] | None = None
    """The curvature and the size that the shell would have without stress"""
    bodies: Bodies = Field(default_factory=dict)
    """Name -> rigid body that presses on the shell, or stands in its way"""
    contact: Pairs = Field(default=[])
    """Pairs that may touch, half a thickness from their mid-surfaces (of rubber half the deformed
    one), without friction: [[shell, shell]] is the shell with itself; in place of `shell` the name
    of one of several shells, or of a patch of a mesh file; with keys {between: [shell, shell],
    stiffness: 1e5}"""
    joints: Joints = Field(default=[])
    """Edges of several shells that meet, and how they are joined"""
    loading: Loading | None = None
    """The load after the field, without which the path ends with the field; or a list of steps, one
    after the other, in which the field is a step too"""
    mesh: MeshSection = MeshSection.model_construct()
    """Elements"""
    stability: StabilitySection | None = None
    """Lowest modes after the run"""
    frequencies: FrequenciesSection | None = None
    """Natural frequencies at points of the path"""
    gradients: Annotated[GradientsSection, LazyValidation(GradientsSection)] | None = None
    """Derivatives of results after the run"""
    ensemble: Annotated[EnsembleSection, LazyValidation(EnsembleSection)] | None = None
    """What is random, for `magshell ensemble`"""
    design: Annotated[DesignSection, LazyValidation(DesignSection)] | None = None
    """What varies and what is wanted, for `magshell design`"""
    identify: Annotated[IdentifySection, LazyValidation(IdentifySection)] | None = None
    """Which numbers measured data are to determine, for `magshell identify`"""
    output: OutputSection = OutputSection.model_construct()
    """How pictures look"""
    stress: list[str] | None = Field(default=None, max_length=1000)
    """Names of points at which path.csv has membrane forces, moments, shear forces and stresses;
    of a mesh file they may be anywhere. fields/ have forces and stresses too, without points for
    []"""
    reactions: bool | None = None
    """Forces and moments of every support as columns of path.csv; by default where a support
    moves"""
    symmetry: Literal["auto", "none", "half", "axisymmetric"] | Waves = "auto"
    """The part that is modelled: the smallest that the case allows (auto), all (none), one side of
    a mirror plane that shape, supports, fields and load share (half; each of several shells is its
    own image in it), the meridian of what is closed around e3 and has an edge, or those of several
    such shells (axisymmetric), or for a number m the sector of 180/m degrees between two mirror
    planes through e3, which waves cos(mφ) have, of what is closed around e3, of several such shells
    and of mesh files; 1 is a half"""

    _several: SeveralShells | None = PrivateAttr(default=None)

    @property
    def several(self) -> SeveralShells | None:
        """Shells of a case that has several; None of one shell."""
        return self._several

    @property
    def members(self) -> Sequence[MemberCase]:
        """The shells of the case, each with a case of its own; of one shell this case itself."""
        if self.several:
            return self.several.parts
        section = OneOfShells.model_construct(
            shell=self.shell, boundary=self.boundary, points=self.points
        )
        return [MemberCase("", section, self)]

    def with_shells(self, parts: Sequence[MemberCase]) -> Self:
        """Return a copy of a case of several shells, whose imperfections have changed.

        `parts` are the changed shells in the order of the file; joints and pairs remain.
        """
        assert self.several
        several = SeveralShells(parts, self.several.joints, self.several.pairs, self.several.bodies)
        shell = self.shell.model_copy(update={"file": several.file})
        assert isinstance(shell, MeshSurface)
        sections = {member.name: member.section for member in parts}
        copied = self.model_copy(update={"shell": shell, "shells": sections})
        copied._several = several
        # the "file" of this shell is the mesh of all shells, in memory
        shell.files.given[shell.path] = several.assembly
        return copied

    @model_serializer(mode="wrap")
    def _plain_data(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Return the plain data of the case, without keys that were made from its `shells`."""
        return without_merged_keys(handler(self), self.shells)

    @model_validator(mode="wrap")
    @classmethod
    def _units_go_with_those_of_the_shell(
        cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo
    ) -> Self:
        """Merge several shells into one mesh, validate, and check that lengths agree in units.

        Raises ValueError for the first length with a unit if the shell's lengths have none.
        """
        data, several = merge_shells(data, info.context, cls)
        section = handler(data)
        if several and isinstance(section.shell, MeshSurface):
            section._several = several
            section.shell.files.given[section.shell.path] = several.assembly
        # a shell with units accepts lengths without: they are in metres
        if isinstance(data, dict) and not section.shell.with_units:
            for key in section._with_units(data):
                raise ValueError(
                    f"{key}: has a unit, but the shell's lengths have none: give all of them one, "
                    "or none"
                )
        return section

    def _with_units(self, data: Mapping[str, Any]) -> Iterator[str]:
        """Yield the keys in plain data of the case whose lengths have units.

        Only the sections that must agree with the shell's lengths are searched.
        """
        for key in SECTIONS_WITH_SHELL_UNITS:
            yield from numbers_with_units(getattr(self, key), data.get(key), key)
        shell = data.get("shell")
        if isinstance(shell, Mapping):
            for key in ("imperfections", "defect"):
                yield from numbers_with_units(
                    getattr(self.shell, key, None), shell.get(key), f"shell.{key}"
                )

    @model_validator(mode="after")
    def _abilities_fit(self) -> Self:
        """Check that abilities and load steps have what they need, and that patches are known."""
        for ability in self.context.abilities:
            ability.refuse_unfit(self.context)
        for key, patches in self.patches.items():
            refuse_unknown_patches(key, patches, self.shell, self.dimples)
        refuse_unfit_steps(self.context)
        return self

    def problem(self, smooth: Collection[str] = ()) -> "Problem":
        """Return the problem of the case: mesh, loads and supports, not yet built.

        Parameters
        ----------
        smooth
            Keys whose formulas are known to have no details between samples.

        Raises
        ------
        CaseError
            If the requested symmetry is not there, or the case asks for something that cannot be
            built.
        MeshError
            If a support or a load names an edge or a point that the meridian does not have.
        """
        from magshell_fenicsx.case.planner import make_problem  # the solver takes long to import

        make = partial(make_problem, self, smooth=smooth)
        return make().made_by(make)

    @property
    def patches(self) -> dict[str, Iterable[str]]:
        """Key of the case -> names of its patches, for all keys that have values by patch."""
        patches = dict[str, Iterable[str]]()
        for ability in self.context.abilities:
            patches |= ability.patches()
        return patches

    @model_validator(mode="after")
    def _model_fits(self) -> Self:
        """Check that shell or solid, mesh and symmetry go together."""
        is_mesh_file = isinstance(self.shell, MeshSurface)
        size_keys = sorted(self.mesh.model_fields_set & {"size", "refinement", "tolerance"})
        is_one_mesh_file = is_mesh_file and not self.several
        if size_keys and is_one_mesh_file:
            raise ValueError(
                f"mesh.{size_keys[0]}: not with geometry: mesh, whose elements are those of the "
                "file"
            )
        if self.model == "shell":  # the rules that follow are those of a solid
            if self.solid:
                raise ValueError("solid belongs to model: solid")
            return self
        if isinstance(self.thickness_factor, dict | UserField):
            raise ValueError(
                "shell.thickness_factor: of a solid a formula: a step in the thickness is no swept "
                "body"
            )
        self.mesh.refuse_unfit_solid(mesh_file=is_mesh_file)
        if self.symmetry not in ("auto", "none", "half"):
            raise ValueError(f"symmetry: {self.symmetry}: a solid is whole or half")
        if self.solid:
            self.solid.refuse_unfit(self.shell.poisson_ratio)
        return self

    @cached_property
    def context(self) -> Context:
        """Sections, units and steps of the case, in the form that its parts read."""
        sections = {key: getattr(self, key) for key in type(self).model_fields}
        sections["imperfections"] = self.imperfections
        # load steps are planned from a context without them, which then gets them
        is_programme, is_solid = isinstance(self.loading, list), self.model == "solid"
        without_steps = Context(
            self.shell, self.points, sections, is_programme=is_programme, solid=is_solid
        )
        return replace(without_steps, steps=programme(self.loading, without_steps))

    @property
    def programme(self) -> tuple[ProgrammeStep, ...]:
        """Load steps of the case in their order.

        Before a single load the natural shape grows, then the field.
        """
        return tuple(self.context.steps)

    @property
    def approaches(self) -> dict[str, str]:
        """Name of a body -> name of the amplitude by which it approaches the shell."""
        return approaches(self.bodies, list(loads_by_key(self.loading).values()))

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with some sections changed; its parts read the copy, not the original."""
        copied = super().model_copy(update=update, deep=deep)
        copied.__dict__.pop("context", None)  # the cached one has the sections of the original
        return copied

    @property
    def imperfections(self) -> dict[str, ImperfectionSection]:
        """Key below `shell` -> section of each imperfection; `defect` is one of them."""
        shell = self.shell
        # the short form of a single imperfection, which these shapes have
        if isinstance(shell, ShellSection | CapSurface | RevolutionSurface) and shell.defect:
            return {"defect": shell.defect}
        sections = dict[str, ImperfectionSection]()
        for i, section in enumerate(shell.imperfections):
            for key, imperfection in section.listed().items():
                sections[f"imperfections.{i}{key}"] = imperfection
        return sections

    @property
    def dimples(self) -> dict[str, str]:
        """Name of the patch within each dimple's rim -> key of the dimple in `imperfections`."""
        keys = [key for key, section in self.imperfections.items() if section.patch]
        return {"dimple" if i == 0 else f"dimple_{i + 1}": key for i, key in enumerate(keys)}

    @property
    def thickness_factor(self) -> str | dict[str, float] | UserField | None:
        """Factor of the thickness: a formula, patch -> number, or a user function; None for 1."""
        return self.shell.thickness_factor

    @property
    def width(self) -> float | None:
        """Width of a strip over its length; None of other shapes."""
        return self.shell.width if isinstance(self.shell, ShellSection) else None

    @property
    def lambda_m(self) -> float:
        """|Br||Ba|/(mu_0 E); 0 without a field."""
        return strength(self.context)

    @property
    def remanent(self) -> RemanentSection | None:
        """Remanence of the shell; None without."""
        return self.magnetic.remanent if self.magnetic else None

    @property
    def sources(self) -> Sequence[SourceSection]:
        """Sources of the applied field."""
        return (self.magnetic.applied.sources if self.magnetic else None) or []

    @property
    def time_unit(self) -> float | None:
        """The unit R √(ρ/E) of times, in s where the case has units; None without density."""
        return self.context.time_unit

    @property
    def outside(self) -> dict[str, str | None]:
        """Key -> hash of what a result depends on besides the case's own keys.

        That is the mesh file, other files, and user-defined energies.
        """
        mesh = {"mesh_file": self.shell.digest} if isinstance(self.shell, MeshSurface) else {}
        readers = {key: s for key, s in self.readers.items() if s is not self.shell}
        return mesh | digests(readers) | self.term_digests

    @property
    def readers(self) -> dict[str, FileKeys]:
        """Key -> section, of all sections that read a file.

        Keys of imperfections are those below `shell`.
        """
        sections: dict[str, object] = {
            "shell": self.shell,
            "magnetic.remanent": self.remanent,
        }
        sections |= self.imperfections | {
            f"magnetic.applied.sources.{i}": s for i, s in enumerate(self.sources)
        }
        sections |= self.several.readers if self.several else {}
        return {key: s for key, s in sections.items() if isinstance(s, FileKeys) and s.file}

    def with_place(self, message: str) -> str:
        """Return a message with file and line of the key that it begins with."""
        return super().with_place(in_words_of_shells(message, self.origin.data))

    @classmethod
    def load(cls, file: str | Path, settings: Sequence[str] = ()) -> "Case":
        """Read a case file, with `key.path=value` settings in place of its own.

        Raises
        ------
        CaseError
            One message with every mistake: file, line, key, value, what is allowed.
        """
        return cls.from_source(read_source(Path(file), settings))

    @classmethod
    def from_source(cls, source: Source | Mapping[str, Any]) -> "Case":
        """Return the validated case of a mapping, or of a `Source`, which knows places in a file.

        Raises
        ------
        CaseError
            One message with every mistake: file, line, key, value, what is allowed; for a mapping
            it begins with the key.
        """
        if not isinstance(source, Source):  # a mapping has no file: messages begin with the key
            source = Source("case", dict(source))
        try:
            context = {"folder": source.folder, "files": source.files}
            case = cls.model_validate(source.data, context=context)
            return case.written_as(Origin(source.place, deepcopy(source.data), context))
        except ValidationError as e:
            raise InvalidCase(
                e.errors(), source, cls, partial(in_words_of_shells, data=source.data)
            ) from None
