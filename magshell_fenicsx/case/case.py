"""The whole case: its sections and what they must have in common."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from functools import cached_property
from math import radians
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
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

from magshell_fenicsx.case.loading import Loading, listed, programme, refuse_strange, refuse_unfit_steps
from magshell_fenicsx.case.shells import Several, Shells, expanded, written
from magshell_fenicsx.input.expressions import is_formula
from magshell_fenicsx.input.messages import InvalidCase
from magshell_fenicsx.input.section import NOTED, Chosen, FileKeys, digests, lengths_with_units, texts
from magshell_fenicsx.input.source import Source, read_source
from magshell_fenicsx.mesh.patch import GivenField
from magshell_fenicsx.parts.bodies.body import refuse_unfit_bodies, with_units
from magshell_fenicsx.parts.bodies.press import approaches
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection
from magshell_fenicsx.parts.joints import Joints, refuse_unfit_joints
from magshell_fenicsx.parts.kinds import Bodies
from magshell_fenicsx.parts.laminate import LaminateSection
from magshell_fenicsx.parts.magnetism.fields import MagneticSection, RemanentSection, layer_average, strength
from magshell_fenicsx.parts.magnetism.sensors import Sensors
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection
from magshell_fenicsx.parts.motion.history import refuse_unfit_viscosity
from magshell_fenicsx.parts.natural.section import NaturalSection, measured
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.registered import PARTS, Origin, WithParts, parts_of
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.supports.boundary import EDGES, BoundarySection, refuse_taken
from magshell_fenicsx.parts.touching.section import Pairs, refuse_unfit_pairs
from magshell_fenicsx.problem.sizes import MeshSection, SolidSection
from magshell_fenicsx.problem.wanted import FrequenciesSection, GradientsSection, OutputSection, StabilitySection
from magshell_fenicsx.shape.ground import Coordinates
from magshell_fenicsx.shape.sections import (
    CapSurface,
    MeshSurface,
    RevolutionSurface,
    ShellSection,
    Surface,
    SurfaceSection,
)
from magshell_fenicsx.studies.identify_sections import IdentifySection
from magshell_fenicsx.studies.sections import DesignSection, EnsembleSection

if TYPE_CHECKING:
    from magshell_fenicsx.problem.problem import Problem


class Case(WithParts):
    """A shell, what holds it, its field and its load; validated."""

    model: Literal["shell", "solid"] = "shell"
    """A thin shell, or its body in three dimensions"""
    shell: Annotated[ShellSection | Surface, Chosen("geometry"), NOTED]
    """Mid-surface, thickness and material"""
    solid: SolidSection | None = None
    """Of `model: solid`"""
    boundary: BoundarySection
    """What is held"""
    points: dict[str, Coordinates] = Field(default_factory=dict)
    """Name -> place of what is loaded, held or watched [the shell's length; over R if that has no unit]"""
    shells: Shells | None = None
    """Name -> one of several shells, in place of `shell`, `boundary`, `points` and `magnetic.remanent`. The R of the
    first is that of formulas and results, its thickness the h of these; all have one material. The edge or point `rim`
    of the shell `upper` is `upper.rim` in a case and `upper_rim` in columns; the shell itself is the patch `upper`"""
    magnetic: MagneticSection | None = None
    """Remanence and applied field, which is applied before the load"""
    sensors: Sensors = Field(default_factory=dict)
    """Name -> point at which the magnetic field is read"""
    natural: NaturalSection | None = None
    """The curvature and the size that the shell would have without stress"""
    bodies: Bodies = Field(default_factory=dict)
    """Name -> rigid body that presses on the shell, or stands in its way"""
    contact: Pairs = Field(default=[])
    """Pairs that may touch, half a thickness from their mid-surfaces, without friction: [[shell, shell]] is the shell
    with itself; in place of `shell` the name of one of several shells, or of a patch of a mesh file"""
    joints: Joints = Field(default=[])
    """Edges of several shells that meet, and how they are joined"""
    loading: Loading | None = None
    """The load after the field, without which the path ends with the field; or a list of steps, one after the other,
    in which the field is a step too"""
    mesh: MeshSection = MeshSection.model_construct()
    """Elements"""
    stability: StabilitySection | None = None
    """Lowest modes after the run"""
    frequencies: FrequenciesSection | None = None
    """Natural frequencies at points of the path"""
    gradients: GradientsSection | None = None
    """Derivatives of results after the run"""
    ensemble: EnsembleSection | None = None
    """What is random, for `magshell ensemble`"""
    design: DesignSection | None = None
    """What varies and what is wanted, for `magshell design`"""
    identify: IdentifySection | None = None
    """Which numbers measured data are to determine, for `magshell identify`"""
    output: OutputSection = OutputSection.model_construct()
    """How pictures look"""
    reactions: bool | None = None
    """Forces and moments of every support as columns of path.csv; by default where a support moves"""
    symmetry: Literal["auto", "none", "half", "axisymmetric"] = "auto"
    """The part that is modelled: the smallest that the case allows (auto), all (none), one side of a mirror plane
    that shape, supports, fields and load share (half), the meridian of what is closed around e3 and has an edge
    (axisymmetric)"""

    _several: Several | None = PrivateAttr(default=None)

    @property
    def several(self) -> Several | None:
        """The shells of a case that has several."""
        return self._several

    @model_serializer(mode="wrap")
    def _written(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        return written(handler(self), self.shells)

    @model_validator(mode="wrap")
    @classmethod
    def _units_go_with_those_of_the_shell(
        cls, data: Any, handler: ModelWrapValidatorHandler[Self], info: ValidationInfo
    ) -> Self:
        data, several = expanded(data, info.context, cls)
        section = handler(data)
        if several and isinstance(section.shell, MeshSurface):
            section._several = several
            section.shell.files.given[section.shell.path] = several.assembly
        if isinstance(data, dict) and not section.shell.with_units:
            parts = {key: data.get(key) for key in ("points", "mesh", "sensors", *PARTS)}
            written = listed(data.get("loading"))
            for key, load in listed(section.loading).items():
                if load.measured and isinstance(written[key], dict):
                    parts[key] = {name: value for name, value in written[key].items() if name != "hold"}
            for key in (
                *texts(parts, is_formula),
                *measured(data.get("natural")),
                *_imperfections_with_units(section, data["shell"]),
                *with_units(section.bodies, data.get("bodies")),
            ):
                raise ValueError(f"{key}: has a unit, but the shell's lengths have none: give all of them one, or none")
        return section

    @model_validator(mode="after")
    def _sections_fit(self) -> Self:
        known = self.magnetic is None or self.magnetic.lambda_m is not None or self.magnetic.without_field
        if not known and self.shell.youngs_modulus is None:
            raise ValueError("shell.youngs_modulus is needed to turn flux densities into lambda_m")
        if self.magnetic and self.magnetic.applied.sources and not self.shell.with_units:
            raise ValueError(
                "magnetic.applied.sources: are in metres and tesla: give youngs_modulus and the shell's lengths units"
            )
        if self.sensors and self.magnetic is None:
            raise ValueError("sensors: need magnetic: nothing is magnetised, and no field applied")
        if self.magnetic and self.magnetic.interaction != "none" and "symmetry" in self.boundary.conditions().values():
            raise ValueError(
                "magnetic.interaction: needs the whole shell: with boundary: symmetry the case is a part of it alone"
            )
        if self.sensors and "symmetry" in self.boundary.conditions().values():
            raise ValueError("sensors: need the whole shell: with boundary: symmetry the case is a part of it alone")
        if self.magnetic and self.magnetic.without_field and not self.sensors and self.magnetic.interaction == "none":
            raise ValueError("magnetic: give lambda_m, or remanent.flux_density and applied.flux_density")
        if self.magnetic and self.magnetic.energy != "full" and self.shell.law != "koiter":
            raise ValueError(
                f"magnetic.energy: {self.magnetic.energy}: the expansions are for a thickness that does not change; "
                f"with shell.law: {self.shell.law} give full"
            )
        if self.sensors and self.shell.law != "koiter" and self.natural and self.natural.stretch is not None:
            raise ValueError(
                f"sensors: with shell.law: {self.shell.law} and natural.stretch: the field of a shell whose volume "
                "grows is not built"
            )
        if self.shell.laminate:
            self._refuse_unfit_laminate(self.shell.laminate)
        layers = self.remanent.layers if self.remanent else None
        if layers and self.model == "shell" and np.linalg.norm(layer_average(layers)) < 1e-9:
            raise ValueError(
                "magnetic.remanent.layers: the layers cancel: their average is a remanence of length zero, and a shell "
                "knows no more of them"
            )
        return self

    def _refuse_unfit_laminate(self, laminate: LaminateSection) -> None:
        laminate.refuse_unfit_units(self.shell)
        if self.model == "solid":
            raise ValueError("shell.laminate: is of a shell: take model: shell")
        if laminate.twists and "symmetry" in self.boundary.conditions().values():
            raise ValueError(
                "boundary: symmetry: no plane mirrors a laminate that twists: for each ply lay one at -angle, at the "
                "same distance from the middle, or model the whole shell"
            )

    @model_validator(mode="after")
    def _imperfections_fit(self) -> Self:
        shell = self.shell
        if getattr(shell, "defect", None) and shell.imperfections:
            raise ValueError("shell.imperfections: give these or defect; a dimple of the list is the same as defect")
        edge = None if shell.edge_polar is None else radians(shell.edge_polar)
        for key, section in self.imperfections.items():
            try:
                section.refuse_unfit(shell.R_over_h, shell.poisson_ratio, edge)
            except ValueError as e:
                raise ValueError(f"shell.{key}: {e}") from None
        return self

    @model_validator(mode="after")
    def _named_parts_are_there(self) -> Self:
        shell = self.shell
        refuse_taken(self.points)
        for key in parts_of(self.context):
            self.context.has_modulus(key)
        if isinstance(shell, ShellSection):
            edges = EDGES[shell.geometry]
            for name in self.boundary.conditions():
                if name not in edges and name not in self.points:
                    raise ValueError(f"boundary.{name}: a {shell.geometry} has no such edge, only {', '.join(edges)}")
        for key, patches in self.patches.items():
            refuse_strange(key, patches, shell, self.dimples)
        return self

    def problem(self) -> "Problem":
        """What will be computed.

        Raises
        ------
        CaseError, MeshError
            See `make_problem`.
        """
        from magshell_fenicsx.case.planner import make_problem  # the solver takes long to import

        return make_problem(self)

    @property
    def patches(self) -> dict[str, Iterable[str]]:
        """Keys with values by patch -> the names of these."""
        found = {f"natural.{key}": getattr(self.natural, key, None) for key in ("curvature", "stretch")}
        found["magnetic.remanent.patches"] = self.remanent and self.remanent.patches
        found["magnetic.susceptibility"] = self.magnetic and self.magnetic.susceptibility
        return {key: patches for key, patches in found.items() if isinstance(patches, dict)}

    @model_validator(mode="after")
    def _mesh_fits(self) -> Self:
        shell = self.shell
        if isinstance(shell, MeshSurface) and not self.several:
            for key in sorted(self.mesh.model_fields_set & {"size", "refinement", "tolerance"}):
                raise ValueError(f"mesh.{key}: not with geometry: mesh, whose elements are those of the file")
        by_densities = self.magnetic is not None and self.magnetic.lambda_m is None and not self.magnetic.without_field
        if by_densities and isinstance(shell, SurfaceSection) and not shell.with_units:
            raise ValueError(
                "magnetic: flux densities need shell.youngs_modulus in pascals: give youngs_modulus and lengths units, "
                "or lambda_m"
            )
        return self

    @model_validator(mode="after")
    def _what_a_solid_can(self) -> Self:
        if self.model == "shell":
            if self.solid:
                raise ValueError("solid belongs to model: solid")
            return self
        if isinstance(self.thickness_factor, dict | GivenField):
            raise ValueError("shell.thickness_factor: of a solid a formula: a step in the thickness is no swept body")
        if self.remanent and isinstance(self.remanent.components, GivenField):
            raise ValueError("magnetic.remanent: of a solid a formula: a function on the mesh is that of a shell")
        if self.sensors:
            raise ValueError("sensors: read the field of a shell: take model: shell")
        if self.natural and self.natural.given:
            raise ValueError("natural: of a solid numbers and formulas: a function on the mesh is that of a shell")
        if self.magnetic and self.magnetic.energy != "full":
            raise ValueError(
                f"magnetic.energy: {self.magnetic.energy}: the expansions are of a shell; a solid has the full energy"
            )
        if self.shell.law == "mooney-rivlin":
            raise ValueError("shell.law: mooney-rivlin: is of a shell; a solid is neo-Hookean")
        self.mesh.refuse_unfit_solid(read=isinstance(self.shell, MeshSurface))
        if self.symmetry == "axisymmetric":
            raise ValueError("symmetry: axisymmetric: a solid is whole or half")
        if self.solid:
            self.solid.refuse_unfit(self.shell.poisson_ratio)
        return self

    @model_validator(mode="after")
    def _bodies_fit(self) -> Self:
        for name, body in self.bodies.items():
            self.context.on_shell(f"bodies.{name}", 0.0 if body.at.point else body.at.polar)
        refuse_unfit_bodies(self.bodies, solid=self.model == "solid")
        return self

    @model_validator(mode="after")
    def _contact_fits(self) -> Self:
        refuse_unfit_pairs(self.contact, self.context, self.symmetry)
        refuse_unfit_joints(self.joints, self.context)
        return self

    @model_validator(mode="after")
    def _programme_fits(self) -> Self:
        density = self.time_unit is not None and self.shell.with_units
        refuse_unfit_viscosity(self.shell, self.natural, density=density, solid=self.model == "solid")
        refuse_unfit_steps(self.context)
        return self

    @cached_property
    def context(self) -> Context:
        """What its parts know of it."""
        sections = {key: getattr(self, key) for key in type(self).model_fields}
        sections["imperfections"] = self.imperfections
        whole, solid = isinstance(self.loading, list), self.model == "solid"
        around = Context(self.shell, self.points, sections, whole=whole, solid=solid)
        return replace(around, steps=programme(self.loading, around))

    @property
    def programme(self) -> tuple[ProgrammeStep, ...]:
        """Its steps; before a single load the natural shape grows, then the field."""
        return tuple(self.context.steps)

    @property
    def approaches(self) -> dict[str, str]:
        """Body -> name of its approach, the amplitude."""
        return approaches(self.bodies, list(listed(self.loading).values()))

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """A copy with some sections changed, whose parts know it and not this one."""
        copied = super().model_copy(update=update, deep=deep)
        copied.__dict__.pop("context", None)
        return copied

    @property
    def imperfections(self) -> dict[str, ImperfectionSection]:
        """Key of each imperfection below `shell` -> section; `defect` is one of them."""
        shell = self.shell
        defect = shell.defect if isinstance(shell, ShellSection | CapSurface | RevolutionSurface) else None
        listed = dict[str, ImperfectionSection]()
        for i, section in enumerate(shell.imperfections):
            listed |= {f"imperfections.{i}{key}": each for key, each in section.listed().items()}
        return {"defect": defect} if defect else listed

    @property
    def dimples(self) -> dict[str, str]:
        """Names of the patches within the rims of dimples -> keys of `imperfections`."""
        keys = [key for key, section in self.imperfections.items() if section.patch]
        return {"dimple" if i == 0 else f"dimple_{i + 1}": key for i, key in enumerate(keys)}

    @property
    def thickness_factor(self) -> str | dict[str, float] | GivenField | None:
        """What multiplies h: a formula, numbers of patches, or a function of a program."""
        return self.shell.thickness_factor

    @property
    def width(self) -> float | None:
        """Of a strip, over its length."""
        return self.shell.width if isinstance(self.shell, ShellSection) else None

    @property
    def lambda_m(self) -> float:
        """|Br||Ba|/(mu_0 E); 0 without a field."""
        return strength(self.context)

    @property
    def remanent(self) -> RemanentSection | None:
        """What is magnetised for good."""
        return self.magnetic.remanent if self.magnetic else None

    @property
    def sources(self) -> Sequence[SourceSection]:
        """Of the applied field."""
        return (self.magnetic.applied.sources if self.magnetic else None) or []

    @property
    def time_unit(self) -> float | None:
        """See `Context.time_unit`."""
        return self.context.time_unit

    @property
    def outside(self) -> dict[str, str | None]:
        """Hashes of what is solved besides its own keys: mesh file, other files, user-defined energies."""
        mesh = {"mesh_file": self.shell.digest} if isinstance(self.shell, MeshSurface) else {}
        return mesh | digests({key: s for key, s in self.readers.items() if s is not self.shell}) | self.term_digests

    @property
    def readers(self) -> dict[str, FileKeys]:
        """The sections that read a file, by key; those below `shell` without that."""
        sections: dict[str, object] = {
            "shell": self.shell,
            "magnetic.remanent": self.remanent,
        }
        sections |= self.imperfections | {f"magnetic.applied.sources.{i}": s for i, s in enumerate(self.sources)}
        sections |= self.several.readers if self.several else {}
        return {key: s for key, s in sections.items() if isinstance(s, FileKeys) and s.file}

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
        """A case of a mapping like a case file, or of a `Source`, which knows its places in a file.

        Raises
        ------
        CaseError
            See `load`; of a mapping the message begins with the key.
        """
        if not isinstance(source, Source):
            source = Source("case", dict(source))
        try:
            context = {"folder": source.folder, "files": source.files}
            case = cls.model_validate(source.data, context=context)
            return case.written_as(Origin(source.place, deepcopy(source.data), context))
        except ValidationError as e:
            raise InvalidCase(e.errors(), source, cls) from None


def _imperfections_with_units(case: Case, shell: dict[str, Any]) -> Iterator[str]:
    """The keys of imperfections that are lengths with a unit in plain data of a shell."""
    written = {f"imperfections.{i}": item for i, item in enumerate(shell.get("imperfections") or [])}
    sections: dict[str, object] = {f"imperfections.{i}": each for i, each in enumerate(case.shell.imperfections)}
    if shell.get("defect"):
        written["defect"], sections["defect"] = shell["defect"], case.imperfections["defect"]
    for key, item in written.items():
        section = sections[key]
        assert isinstance(section, ImperfectionSection)
        yield from lengths_with_units(type(section), item, f"shell.{key}.")
