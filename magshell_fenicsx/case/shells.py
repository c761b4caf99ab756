"""The section `shells`: several shells in place of one, each as a case of its own, and one mesh.

Each shell is planned and meshed by its own case. Together they replace a mesh file, so that all
else sees one surface in pieces: an edge, a point or a patch `rim` of the shell `upper` is
`upper_rim` there.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import ChosenByKey, Direction, FileKeys, Section, or_number
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.multi_shell import MultiShellMesh, ShellPose
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.parts.bodies.body import BodySection
from magshell_fenicsx.parts.laminate import laminate_of
from magshell_fenicsx.parts.magnetism.remanent import RemanentSection
from magshell_fenicsx.parts.shell_sections import ShellSection, Surface
from magshell_fenicsx.parts.supports.boundary import BoundarySection
from magshell_fenicsx.shape.reference_shell import Coordinates

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case
    from magshell_fenicsx.models.shell.laminate import Laminate
    from magshell_fenicsx.models.shell.law import Law
    from magshell_fenicsx.models.shell.parameters import ShellMaterial
    from magshell_fenicsx.models.shell.thickness import Thickness

Array = NDArray[np.float64]
Keys = dict[str, Any]
EDGE_NAMES = (  # of all geometries but mesh files
    *(
        "equator",
        "rim",
        "hole",
        "inner",
        "outer",
        "left",
        "right",
        "bottom",
        "top",
        "root",
        "tip",
        "sides",
    ),
)


class PlaceSection(Section):
    """Where a shell is: it is turned about its own origin, then moved.

    It turns by `turn` about e3, then by `axis.polar` about e2, then by `axis.azimuth` about e3: its
    own e3 then has the direction `axis`.
    """

    position: Coordinates = Field(default=[0.0, 0.0, 0.0])
    """Place of its origin [length]"""
    axis: Direction = Direction.model_construct()
    """Direction of its own e3; polar: 180 turns it upside down"""
    turn: float = Field(default=0.0, ge=-360, le=360)
    """Angle about its own e3, before that [degree]"""

    @property
    def Q(self) -> Array:
        """Rotation (3, 3) whose columns are the shell's axes in the frame of the case."""
        turn, polar, azimuth = np.radians([self.turn, self.axis.polar, self.axis.azimuth])
        Q = _about_e3(azimuth) @ _about_e2(polar) @ _about_e3(turn)
        return np.asarray(np.where(np.abs(Q) < 1e-15, 0.0, Q))  # rounding of right angles


class ShellMeshSection(Section):
    """The elements of one shell of several."""

    refinement: float = Field(default=1.0, ge=0.1, le=20)
    """Divides its element sizes, besides that of all"""
    size: Annotated[float, or_number("metre"), Field(gt=0, le=1e12)] | None = None
    """Element size everywhere on it, in place of that of all [the shell's length]"""


class OneOfShells(Section):
    """One shell of several.

    What is its own is in its own frame; conditions and forces are in that of the case.
    """

    shell: Annotated[ShellSection | Surface, ChosenByKey("geometry")]
    """Mid-surface, thickness and material"""
    boundary: BoundarySection = BoundarySection.model_construct()
    """What is held, along the axes of the case"""
    points: dict[str, Coordinates] = Field(default_factory=dict)
    """Name -> place in its own frame [the shell's length; over its R if that has no unit]"""
    remanent: RemanentSection | None = None
    """Its remanence, in its own frame; a shell without is not magnetised"""
    place: PlaceSection = PlaceSection.model_construct()
    """Where it is"""
    mesh: ShellMeshSection | None = None
    """Its elements"""


Shells = Annotated[dict[str, OneOfShells], Field(min_length=1, max_length=50)]


def in_words_of_shells(message: str, data: Any) -> str:
    """Return a message with the names of the case file: `upper.rim` in place of `upper_rim`.

    Parameters
    ----------
    message
        Text with names of edges and points of the common mesh, or with keys of the merged case.
    data
        Plain data of a case. Edges and points that it names are known, and edges of all geometries.

    Examples
    --------
    >>> message = "boundary.a_rim: is joined; its edges: a_top, a_tip_uz"
    >>> in_words_of_shells(message, {"shells": {"a": {}}})
    'shells.a.boundary.rim: is joined; its edges: a.top, a_tip_uz'
    """
    shells = data.get("shells") if isinstance(data, Mapping) else None
    if not isinstance(shells, Mapping):
        return message
    texts = {*_texts(data)}  # all keys and values of the case file
    for name in map(str, shells):
        # possible names of the shell's edges and points: those after "name." anywhere in the case,
        # those in the shell's own section, and the edges of all geometries
        names_in_text = {
            text.removeprefix(f"{name}.")
            for text in texts
            if re.fullmatch(rf"{re.escape(name)}\.\w+", text)
        }
        own_names = filter(str.isidentifier, _texts(shells[name]))
        known_names = "|".join(sorted({*EDGE_NAMES, *names_in_text, *own_names}))
        shell = re.escape(name)
        # first keys: boundary.a_rim becomes shells.a.boundary.rim. Then single names: a_rim becomes
        # a.rim, unless it is part of a path, of a file name or of a column such as a_tip_uz
        message = re.sub(
            rf"\b(boundary|points)\.({shell})_({known_names})\b", r"shells.\2.\1.\3", message
        )
        message = re.sub(rf"(?<![\w./])({shell})_({known_names})\b(?!\.\w)", r"\1.\2", message)
    return message


def _texts(data: Any) -> Iterator[str]:
    """Yield all keys and texts of plain data."""
    if isinstance(data, Mapping):
        for key, value in data.items():
            yield from (str(key), *_texts(value))
    elif isinstance(data, list | tuple):
        yield from (text for item in data for text in _texts(item))
    elif isinstance(data, str):
        yield data


@dataclass(frozen=True)
class MemberCase:
    """A shell of several in a case, with a case of its own.

    Attributes
    ----------
    name
        Name of the shell in the whole case; "" if that has no section `shells`.
    section
        Section of the shell in the whole case.
    case
        The case of this shell alone.
    """

    name: str
    section: OneOfShells
    case: "Case"

    def refused(self, message: str) -> str:
        """Return a message about the shell's own case, beginning with its key in the whole case."""
        return f"shells.{self.name}.{message}" if self.name else message

    @contextmanager
    def naming(self) -> Iterator[None]:
        """Return a context in which errors of the shell's own case get a key in the whole case."""
        try:
            yield
        except (CaseError, MeshError) as e:
            raise type(e)(self.refused(str(e))) from None


class SeveralShells:
    """The shells of a case that has several, and what they have in common.

    Parameters
    ----------
    parts
        The shells, in the order of the file. Results are over the sizes of the first one.
    joints
        Pairs of names of edges that are joined, such as ("a_top", "b_bottom").
    pairs
        Pairs of names of shells that may touch.
    bodies
        Name -> section of each rigid body; meshes are fine where one is near.
    """

    def __init__(
        self,
        parts: Sequence[MemberCase],
        joints: Sequence[tuple[str, str]] = (),
        pairs: Sequence[Sequence[str]] = (),
        bodies: Mapping[str, BodySection] | None = None,
    ) -> None:
        self.parts, self.joints, self.pairs = parts, joints, pairs
        self.bodies = bodies or {}

    def __deepcopy__(self, memo: dict[int, Any]) -> "SeveralShells":
        return self

    @cached_property
    def digest(self) -> str:
        """Hash of all data from which the shells are made."""
        contents = list[list[Any]]()
        for member in self.parts:
            # the last entries: of each imperfection the number of modes for which it waits
            content = [
                member.name,
                member.case.model_dump_json(),
                member.section.place.model_dump_json(),
                member.case.outside,
                *(section.pending_modes for section in member.case.imperfections.values()),
            ]
            contents.append(content)
        contents += [[name, body.model_dump_json()] for name, body in self.bodies.items()]
        return hashlib.sha256(
            json.dumps([contents, self.joints, self.pairs], sort_keys=True).encode()
        ).hexdigest()

    @property
    def file(self) -> str:
        """Name of the mesh file that the shells replace, made from `digest`."""
        return f"shells {self.digest[:16]}"

    def place(self, part: MemberCase) -> ShellPose:
        """Return position, orientation and scale of a shell, over the R of the first shell."""
        R, place = self.parts[0].case.shell.reference, part.section.place
        return ShellPose(place.Q, np.array(place.position) / R, part.case.shell.reference / R)

    @cached_property
    def assembly(self) -> MultiShellMesh:
        """All shells as one mesh, which is triangulated at its first use."""
        from magshell_fenicsx.case.coaxial import meridians  # the solver takes long to import
        from magshell_fenicsx.case.member_meshes import MemberMeshes

        materials = self.materials or {}
        moduli = {
            member.name: materials[member.name].modulus if materials else 1.0
            for member in self.parts
        }
        laws = {
            member.name: "laminate" if member.case.shell.laminate else member.case.shell.law
            for member in self.parts
        }
        members = MemberMeshes(self)
        # functions that return planes of symmetry, meridians, the normal at a place, and the mesh
        # of all halves; in the order of the fields of `MultiShellMesh`
        functions_of_members = (
            members.mirrors,
            partial(meridians, self),
            members.normal,
            members.halved,
        )
        return MultiShellMesh(
            self.digest, members.whole_shells, self.joints, moduli, laws, *functions_of_members
        )

    def shell_of(self, name: str) -> str:
        """Return the name of the shell that has an edge; a shell's name is returned as it is."""
        # the name of an edge begins with that of its shell and an underscore
        return next(
            (part.name for part in self.parts if f"{name}_".startswith(f"{part.name}_")), name
        )

    @cached_property
    def thickness(self) -> "Thickness | None":
        """Thickness of all shells over that of the first, by patch; None if all are 1.

        Raises CaseError or MeshError if a shell's own case cannot be planned.
        """
        from magshell_fenicsx.models.shell.thickness import PlacedFactor, Thickness

        factors: dict[str, Any] = {}
        for member in self.parts:
            with member.naming():
                own_thickness = member.case.problem().thickness
            ratio = self.ratio(member)  # of its nominal thickness to that of the first shell
            factors[member.name] = ratio
            # a shell's own factor, which multiplies the ratio: a formula in its own frame, or
            # numbers by its own patches
            if own_thickness and own_thickness.of_position:
                factors[member.name] = PlacedFactor(own_thickness, self.place(member), ratio)
            own_patches = own_thickness.patches if own_thickness else None
            for name, factor in (own_patches or {}).items():
                assert isinstance(factor, float)  # a shell of its own has no shells in it
                factors[f"{member.name}_{name}"] = ratio * factor
        if all(factor == 1.0 for factor in factors.values()):
            return None
        return Thickness(patches=factors)

    @cached_property
    def materials(self) -> "dict[str, ShellMaterial] | None":
        """Name of a shell -> its material over that of the first shell; None if all are alike."""
        from magshell_fenicsx.models.shell.parameters import ShellMaterial

        first_shell, materials = self.parts[0].case.shell, dict[str, ShellMaterial]()
        laws = list(self.laws)
        for member in self.parts:
            shell, keys = member.case.shell, ("modulus", "density")
            # shells without a modulus or density have a ratio of one
            modulus_ratio, density_ratio = (
                (getattr(shell, key) or 1.0) / (getattr(first_shell, key) or 1.0) for key in keys
            )
            materials[member.name] = ShellMaterial(
                modulus_ratio, shell.poisson_ratio, density_ratio, laws.index(self._law(member))
            )
        return None if len({*materials.values()}) == 1 else materials

    @cached_property
    def laws(self) -> "tuple[Law, ...]":
        """The different laws of elasticity, that of the first shell at the beginning."""
        return tuple(dict.fromkeys(self._law(member) for member in self.parts))

    def _law(self, part: MemberCase) -> "Law":
        """Return the law of elasticity of a shell, with Poisson's ratio of the first shell.

        So laws that differ in Poisson's ratio alone are equal; `materials` has each shell's own
        ratio.
        """
        from magshell_fenicsx.models.shell.parameters import Material

        first_shell = self.parts[0].case.shell
        nu, h = first_shell.poisson_ratio, 1 / first_shell.R_over_h
        elastic_law = part.case.shell.law_section.elastic_law(h, nu)
        return Material(nu, h, elastic_law, self.laminates.get(part.name)).law

    @cached_property
    def laminates(self) -> "dict[str, Laminate]":
        """Name of each shell with plies -> its plies, placed in the frame of the case."""
        laminates: dict[str, Laminate] = {}
        for member in self.parts:
            if laminate := laminate_of(member.case.shell, turn=0.0):
                place = self.place(member)
                laminates[member.name] = replace(laminate, axes=place.Q, origin=place.position)
        return laminates

    @property
    def scale_lines(self) -> list[str]:
        """Lines of `magshell check` on the sizes of each shell over those of the first."""
        has_density = self.parts[0].case.shell.density is not None
        scales = "R, h, E, nu and the density" if has_density else "R, h, E and nu"
        lines = [f"scales: {scales} are those of the shell {self.parts[0].name}"]
        law_words = self.assembly.laws  # name of a shell -> its law in words
        for member in self.parts[1:]:
            # thickness, material where shells differ in it, and law where they differ in that
            line = f"h {self.ratio(member):.4g} times" + (
                "" if member.case.thickness_factor is None else " its factor"
            )
            if material := (self.materials or {}).get(member.name):
                line += f", E {material.modulus:.4g} times, nu = {material.nu:.4g}"
                line += f", density {material.density:.4g} times" if has_density else ""
            line += f", law: {law_words[member.name]}" if len({*law_words.values()}) > 1 else ""
            lines.append(f"  {member.name}: {line}")
        return lines

    def ratio(self, part: MemberCase) -> float:
        """Return the thickness of a shell over that of the first shell."""
        if part is self.parts[0]:
            return 1.0
        first_shell, shell = self.parts[0].case.shell, part.case.shell
        thickness = shell.reference / shell.R_over_h
        return thickness / (first_shell.reference / first_shell.R_over_h)

    @property
    def readers(self) -> dict[str, FileKeys]:
        """Key in the whole case -> section, of all sections of the shells that read a file."""
        by_key = dict[str, FileKeys]()
        for member in self.parts:
            by_key |= {member.refused(key): section for key, section in member.case.readers.items()}
            if member.section.remanent and member.section.remanent.file:
                by_key[member.refused("remanent")] = member.section.remanent
        return by_key


def _rotation_about(i: int, j: int) -> Callable[[float], Array]:
    """Return the rotation (3, 3) from axis i towards axis j, as a function of its angle (rad)."""

    def rotation(angle: float) -> Array:
        """Return the rotation by an angle."""
        Q, c, s = np.eye(3), np.cos(angle), np.sin(angle)
        Q[i, i], Q[i, j], Q[j, i], Q[j, j] = c, -s, s, c
        return Q

    return rotation


_about_e3, _about_e2 = _rotation_about(0, 1), _rotation_about(2, 0)
