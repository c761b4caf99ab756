"""Modes of the perfect shell as imperfections."""

from dataclasses import dataclass
from math import sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.imperfections.modes import ModesSection, Shape
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.scattered import Scattered, scattered
from magshell_fenicsx.parts.imperfections.flaw import Flaw
from magshell_fenicsx.platform.reading import vtk_data
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
EQUAL = 1e-4  # part of the largest value within which crests and troughs are equally large
ON_AXIS = 1e-9  # over R
BESIDE = 0.3  # over R, largest distance of a place of the shell from the nodes of a mode


@dataclass(frozen=True)
class Modes:
    """w0 = -sum of amplitudes times modes, over R."""

    shapes: tuple[Shape, ...]
    amplitudes: tuple[float, ...]

    def __call__(self, places: Array) -> Array:
        w = [a * shape(places) for a, shape in zip(self.amplitudes, self.shapes, strict=True)]
        return np.asarray(-np.sum(w, axis=0)) if w else np.zeros(len(places))


@dataclass(frozen=True)
class Round:
    """f(rho, z) cos(m theta), f through its values at places (rho, 0, z) of the meridian."""

    f: Scattered
    m: int

    def __call__(self, places: Array) -> Array:
        x, y, z = places.T
        f = self.f(np.column_stack([np.hypot(x, y), 0 * z, z]))
        return np.asarray(f * np.cos(self.m * np.arctan2(y, x)))


@dataclass(frozen=True)
class Mirrored:
    """A mode on one side of a plane, and its image with a sign on the other: symmetric to the last digit."""

    shape: Shape
    mirror: Mirror
    sign: float

    def __call__(self, places: Array) -> Array:
        other = self.mirror.beyond(places) < 0
        here = np.where(other[:, None], self.mirror.image(places), places)
        return np.asarray(self.shape(here) * np.where(other, self.sign, 1.0))


def on_surface(places: Array, w: Array, cover: Array) -> Scattered:
    """A mode from its inward displacements (n,) at places (n, 3), scaled to 1."""
    return scattered(places, np.asarray(w / _largest(places, w)), cover, noise=0)


def on_meridian(rho: Array, z: Array, w: Array, m: int) -> Round:
    """A wave around e3 from its inward displacements (n,) along the meridian, with its parity across the axis."""
    places = np.column_stack([rho, 0 * z, z])
    f = np.asarray(w / _largest(places, w))
    if rho.min() < ON_AXIS:
        places, f = np.vstack([places, places * [-1.0, 1.0, 1.0]]), np.concatenate([f, (-1) ** m * f])
    return Round(scattered(places, f, places, noise=0), m)


def modes(section: ModesSection, case: Case, drawn: Outline, key: str) -> Flaw:
    """See `Flaw`; modes that are not yet computed are zero.

    Raises
    ------
    CaseError
        If the file of a mode cannot be used.
    """
    h = 1 / case.shell.R_over_h
    if section.file is not None and section.shapes is None:
        section.become((_read(section, drawn, f"shell.{key}.file: {section.file}"),))
    shapes = section.shapes or ()
    amplitudes = tuple(a * h for a in section.amplitudes[: len(shapes)])
    names = [f"mode {i}{f' (m = {s.m})' if isinstance(s, Round) else ''}" for i, s in enumerate(shapes, 1)]
    words = [f"{a:g} h of {section.file or name}" for a, name in zip(section.amplitudes, names, strict=False)]
    return Flaw(Modes(shapes, amplitudes), 1.2 * sqrt(h), account=", ".join(words) or "modes that the run computes")


def _read(section: ModesSection, drawn: Outline, key: str) -> Scattered:
    try:
        found = vtk_data(section.files.content(section.path), section.path.suffix).point_data
        r0, w = (np.asarray(found[name], dtype=float) for name in ("r0", "mode_w"))
    except Exception as e:  # VTK and pyvista raise many types
        said = getattr(e, "strerror", None) or e
        raise CaseError(f"{key}: is no mode file that a run writes (fields/mode_*.vtu): {said}") from None
    if r0.shape != (len(w), 3) or not (np.isfinite(r0).all() and np.isfinite(w).all() and np.abs(w).max() > 0):
        raise CaseError(f"{key}: the mode has no finite displacement")
    sample = drawn.sample()
    if scipy.spatial.cKDTree(r0).query(sample)[0].max() > BESIDE:
        raise CaseError(f"{key}: is the mode of another shell: it does not reach all places of this one")
    return on_surface(r0, w, sample)


def _largest(places: Array, w: Array) -> float:
    """The largest value with its sign; of equally large ones that of the highest place, whatever their order."""
    size = np.abs(w)
    near = np.flatnonzero(size > (1 - EQUAL) * size.max())
    first = near[np.lexsort(places[near].round(6).T)[-1]]
    return float(np.copysign(size.max(), w[first]))
