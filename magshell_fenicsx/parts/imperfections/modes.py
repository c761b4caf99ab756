"""Modes of the perfect shell as imperfections.

A mode is how the perfect shell begins to buckle. It becomes a shape: a function of places over R,
1 where its displacement w along the normal is largest, inwards positive. w0 is the deviation along
the outward normal, h the thickness, R the reference length. Modes of several shells have a part on
each; a pose maps the frame of one shell to the frame of all. A run computes the modes first, and
then gives them to the section by `become`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from magshell_fenicsx.input.section import FileKeys
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.multi_shell import ShellPose
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionGeometry,
    ImperfectionSection,
    number_over,
)
from magshell_fenicsx.platform.input_files import read_vtk
from magshell_fenicsx.shape.reference_shell import ON_AXIS, ReferenceShell

if TYPE_CHECKING:  # SciPy takes its time, and a case alone does not need it
    from magshell_fenicsx.mesh.scattered_data import ScatteredSpline

Array = NDArray[np.float64]
Shape = Callable[[Array], Array]
Mode = Mapping[str, Shape]  # name of each shell that the mode moves -> its part; "": one shell
CREST_TOLERANCE = (
    1e-4  # part of the largest value within which crests and troughs are equally large
)
MAX_DISTANCE_OVER_R = (
    0.3  # over R, largest distance of a place of the shell from the nodes of a mode
)
SIZE_OVER_WIDTH = 1.2  # of sqrt(R h): elements that show a mode


class ModesSection(FileKeys, ImperfectionSection):
    """The lowest modes of the perfect shell where it first becomes unstable under the case's loads.

    A pressure goes on to there, whatever its target; under other loads without an instability they
    are those at the end. Of each its displacement along the normal, inwards positive, over the
    largest one. Of several shells they are the modes of all together, perfect, and each has its
    part: the largest one may be on another shell.
    """

    kind: Literal["modes"]
    amplitudes: Annotated[
        list[Annotated[float, number_over("h"), Field(ge=-50, le=50)]],
        Field(min_length=1, max_length=20),
    ]
    """Largest w0 of each mode, the lowest mode first; positive: inwards where the mode is largest
    [h]"""
    file: str | None = None
    """A mode file of a run (fields/mode_*.vtu), its path from the folder of the case, in place of
    computed modes"""

    _shapes: tuple[Shape, ...] | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _one_mode_in_a_file(self) -> Self:
        """Refuse several amplitudes beside a file, which has one mode."""
        if self.file is not None and len(self.amplitudes) > 1:
            raise ValueError(
                "amplitudes: a file has one mode: give one amplitude, and an item of the list for "
                "each file"
            )
        return self

    def account(self) -> str:
        return f"modes of {', '.join(f'{a:g}' for a in self.amplitudes)} h"

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(f"amplitudes.{i}" for i in range(len(self.amplitudes)))

    @property
    def shapes(self) -> tuple[Shape, ...] | None:
        """The modes as functions of places over R, 1 where inwards largest; None until computed."""
        return self._shapes

    @property
    def pending_modes(self) -> int:
        return len(self.amplitudes) if self.file is None and self.shapes is None else 0

    @property
    def of_perfect_shell(self) -> bool:
        return self.file is None

    def become(
        self, modes: "Sequence[Mode]", name: str = "", place: ShellPose | None = None
    ) -> None:
        """Take modes of the perfect shell as the shapes of this imperfection.

        Parameters
        ----------
        modes
            The modes, the lowest first.
        name
            Name of the shell in the modes.
        place
            Pose of that shell among the others; None without.

        Raises
        ------
        ValueError
            If no mode with an amplitude moves the shell.
        """

        def part_of(mode: Mode) -> Shape | None:
            """Return the part of a mode in the frame of this shell; None if it does not move it."""
            shape = mode.get(name)
            return PlacedMode(shape, place) if shape and place else shape

        parts = [part_of(mode) for mode in modes[: len(self.amplitudes)]]
        # if there are modes with an amplitude, at least one of them must move this shell
        requested_parts = [
            part for amplitude, part in zip(self.amplitudes, parts, strict=True) if amplitude
        ]
        if requested_parts and not any(requested_parts):
            raise ValueError(
                f"amplitudes: of the {len(parts)} lowest modes of all shells together those with "
                "an amplitude do not move it: give more, and 0 for those of other shells"
            )
        self._shapes = tuple(part or _zero_mode for part in parts)

    def geometry(self, reference: ReferenceShell, key: str) -> ImperfectionGeometry:
        """Return the geometry of the modes; those not yet computed are zero.

        Raises
        ------
        CaseError
            If the file of a mode cannot be used.
        """
        h = reference.h
        if self.file is not None and self.shapes is None:
            mode = _read(self, reference.perfect.sample(), f"{key}.file: {self.file}")
            self.become(({"": mode},))
        shapes = self.shapes or ()
        amplitudes = tuple(a * h for a in self.amplitudes[: len(shapes)])
        # words such as "0.1 h of mode 1 (m = 3)"; m is the number of waves around e3, of a mode
        # that has it
        wave_numbers = [getattr(shape, "m", None) for shape in shapes]
        names = [
            f"mode {i}{'' if m is None else f' (m = {m})'}" for i, m in enumerate(wave_numbers, 1)
        ]
        words = [
            f"{a:g} h of {self.file or name}"
            for a, name in zip(self.amplitudes, names, strict=False)
        ]
        account = ", ".join(words) or "modes that the run computes"
        return ImperfectionGeometry(
            Modes(shapes, amplitudes), SIZE_OVER_WIDTH * sqrt(h), account=account
        )


@dataclass(frozen=True)
class Modes:
    """The deviation w0 = -sum of amplitudes times modes, over R, as a function of places (n, 3)."""

    shapes: tuple[Shape, ...]
    amplitudes: tuple[float, ...]

    def __call__(self, places: Array) -> Array:
        w = [a * shape(places) for a, shape in zip(self.amplitudes, self.shapes, strict=True)]
        return np.asarray(-np.sum(w, axis=0)) if w else np.zeros(len(places))


@dataclass(frozen=True)
class Round:
    """A wave f(rho, z) cos(m theta) around e3, as a function of places (n, 3) over R.

    Attributes
    ----------
    f
        Smooth function through values at places (rho, 0, z) of the meridian.
    m
        Number of waves.
    """

    f: "ScatteredSpline"
    m: int

    def __call__(self, places: Array) -> Array:
        x, y, z = places.T
        f = self.f(np.column_stack([np.hypot(x, y), 0 * z, z]))
        return np.asarray(f * np.cos(self.m * np.arctan2(y, x)))


@dataclass(frozen=True)
class MirroredMode:
    """A mode on one side of a plane, and its image on the other: symmetric to the last digit.

    Attributes
    ----------
    shape
        The mode, which is evaluated where the signed distance from the plane is not negative.
    sign
        1 for a symmetric, -1 for an antisymmetric mode.
    """

    shape: Shape
    mirror: Mirror
    sign: float

    def __call__(self, places: Array) -> Array:
        is_beyond = self.mirror.signed_distance(places) < 0
        on_this_side = np.where(is_beyond[:, None], self.mirror.image(places), places)
        return np.asarray(self.shape(on_this_side) * np.where(is_beyond, self.sign, 1.0))


def _zero_mode(places: Array) -> Array:
    """Return zero displacements (n,) at places (n, 3)."""
    return np.zeros(len(places))


@dataclass(frozen=True)
class PlacedMode:
    """A mode in the frame of one shell, which has its pose among other shells.

    Attributes
    ----------
    shape
        The mode, as a function of places in the frame of all shells.
    place
        The pose: places in the shell's frame -> places in the frame of all shells.
    """

    shape: Shape
    place: ShellPose

    def __call__(self, places: Array) -> Array:
        return self.shape(self.place(places))

    @property
    def m(self) -> int | None:
        """The number of waves around e3, of one that has it."""
        return getattr(self.shape, "m", None)


def on_surface(places: Array, w: Array, cover: Array) -> "ScatteredSpline":
    """Return a mode as a smooth function through inward displacements.

    Parameters
    ----------
    places, w
        Places (n, 3) over R, and displacements (n,) over the largest one.
    cover
        Places (m, 3) that the function must cover.
    """
    from magshell_fenicsx.mesh.scattered_data import fit_scattered

    return fit_scattered(places, w, cover, noise=0)


def on_meridian(places: Array, f: Array, m: int) -> Round:
    """Return a wave around e3 from inward displacements on a meridian.

    Parameters
    ----------
    places, f
        Places (n, 3) of the meridian over R, and displacements (n,) over the largest one.
    m
        Number of waves.
    """
    from magshell_fenicsx.mesh.scattered_data import fit_scattered

    # a meridian that begins on the axis is continued beyond it: waves of odd m change their sign
    if places[:, 0].min() < ON_AXIS:
        places = np.vstack([places, places * [-1.0, 1.0, 1.0]])
        f = np.concatenate([f, (-1) ** m * f])
    return Round(fit_scattered(places, f, places, noise=0), m)


def _is_finite_mode(r0: Array, w: Array) -> bool:
    """Return whether arrays are places (n, 3) and deflections (n,), finite and not all zero."""
    has_places = r0.shape == (len(w), 3)
    if not has_places:
        return False
    is_finite = np.isfinite(r0).all() and np.isfinite(w).all()
    return bool(is_finite and np.abs(w).max() > 0)


def _read(section: ModesSection, sample: Array, key: str) -> "ScatteredSpline":
    """Return the mode in the file of a section as a function of places over R.

    Parameters
    ----------
    sample
        Places (n, 3) all over the perfect shell, which the mode must reach.
    key
        Key and name of the file, for messages.

    Raises
    ------
    CaseError
        If the file has no mode, or that of another shell.
    """
    import scipy

    try:
        fields = read_vtk(section.files.content(section.path), section.path.suffix).point_data
        r0, w = (np.asarray(fields[name], dtype=float) for name in ("r0", "mode_w"))
    except Exception as e:  # VTK and pyvista raise many types
        message = getattr(e, "strerror", None) or e
        raise CaseError(
            f"{key}: is no mode file that a run writes (fields/mode_*.vtu): {message}"
        ) from None
    if not _is_finite_mode(r0, w):
        raise CaseError(f"{key}: the mode has no finite displacement")
    distance_to_node, _ = scipy.spatial.cKDTree(r0).query(sample)
    if distance_to_node.max() > MAX_DISTANCE_OVER_R:
        raise CaseError(
            f"{key}: is the mode of another shell: it does not reach all places of this one"
        )
    return on_surface(r0, over_largest(r0, w), sample)


def over_largest(places: Array, w: Array) -> Array:
    """Return values (n,) over the largest of them in size, with its sign, so that it becomes 1.

    Of several equally large values, the one at the highest of the places (n, 3) gives the sign.
    The result does not depend on the order of the values.
    """
    magnitude = np.abs(w)
    largest_rows = np.flatnonzero(magnitude > (1 - CREST_TOLERANCE) * magnitude.max())
    # lexsort sorts by its last key first, which is z; the last row is the highest. Coordinates
    # count as equal if six decimals are.
    highest_row = largest_rows[np.lexsort(places[largest_rows].round(6).T)[-1]]
    return np.asarray(w / np.copysign(magnitude.max(), w[highest_row]))
