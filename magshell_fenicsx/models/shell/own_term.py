"""An energy of the mid-surface, a part's or one's own, from nothing but its density."""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import basix.ufl
import numpy as np
import ufl
from numpy.typing import NDArray
from ufl import Coefficient, Constant
from ufl.algorithms import expand_derivatives, extract_coefficients
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.constantvalue import Zero
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals
from ufl.geometry import GeometricQuantity

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.shell.kinematics import CURVED, FIRST, SECOND, Jet

Array = NDArray[np.float64]
SAMPLES = 24  # random surfaces on which a symmetry is looked for
SAME = 1e-10  # difference of two values that is rounding, over the larger


@dataclass(frozen=True)
class Free:
    """A parameter of densities that is an amplitude of its own, and may enter them in any way.

    A place, an angle or a natural curvature, for instance: what is conjugate to it is -dPi/dp, a force on what it
    moves. `value` is that of the undeformed shell.
    """

    name: str
    value: float = 0.0


@dataclass(frozen=True)
class OwnTerm:
    """The energy mu Pi(u), Pi the integral of a density over the undeformed mid-surface.

    Of its own name are the term, its amplitude mu and its column. What the density depends on is found from
    it, and so are its derivatives and the symmetries that it leaves to a model.

    Parameters
    ----------
    name
        An identifier.
    density
        Of (r0, u, *parameters): jets of the placement and of the displacement (see `kinematics.Jet`; r = r0 + u),
        lengths in R, to a UFL scalar in E h per undeformed area. It must not depend on the coordinates that the
        jets are taken in: build it from values and from what `kinematics` offers. It may depend on the value and
        the first derivatives of u; an energy of its second derivatives would miss the rotations between cells.
    parameters
        Numbers and vectors; other values of them need no new kernel. A `Free` one can be varied as mu can.
    value
        mu of the undeformed shell, which a path keeps unless it varies mu.
    observed
        Column -> density as above; mu times its integral over the whole shell is observed along a path. A model has
        only the symmetries that these leave too.
    of_volume
        Whether the densities are those of a volume, over E: the thickness multiplies them where it varies, and a solid
        has them in all of its body. They depend on the places r0.r and u.r alone.

    Raises
    ------
    ValueError
        If the name is no identifier or the density is none of these.
    """

    name: str
    density: Callable[..., Expr]
    parameters: tuple[float | Array | Free, ...] = ()
    value: float = 0.0
    observed: Mapping[str, Callable[..., Expr]] = field(default_factory=dict)
    of_volume: bool = False

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"{self.name!r}: a term's name is an identifier, such as foundation")
        if self._symbolic[0].ufl_shape:
            raise ValueError(f"{self.name}: a density is a scalar; this has the shape {self._symbolic[0].ufl_shape}")
        if strangers := self._strangers():
            raise ValueError(
                f"{self.name}: a density is made of its jets and parameters alone; this holds {strangers[0]}. "
                "The position is r0.r, a number that is the same everywhere goes into the parameters"
            )
        if not self.parts:
            raise ValueError(f"{self.name}: the density does not depend on the displacement")
        if curved := [part for part in self.parts if part in SECOND]:
            raise ValueError(
                f"{self.name}: the density depends on {', '.join(f'u.{part}' for part in curved)}; without a term on "
                "the edges it would miss the rotations between cells. Allowed are u.r, u.r1 and u.r2"
            )

        bent = {*self.parts, *self._found_in(self._symbolic[1])} - {"r"}
        if self.of_volume and bent:
            raise ValueError(f"{self.name}: a density of a volume depends on r0.r and u.r alone, not on {min(bent)}")

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """The parts of the displacement's jet that the density depends on."""
        return self._found_in(self._symbolic[2])

    @cached_property
    def placed_parts(self) -> tuple[str, ...]:
        """Those of the placement's jet; the area of the surface takes the first derivatives anyway."""
        return tuple(name for name in ("r", *CURVED) if name in (*FIRST, *self._found_in(self._symbolic[1])))

    @property
    def free(self) -> tuple[Free, ...]:
        """Its parameters that are amplitudes."""
        return tuple(p for p in self.parameters if isinstance(p, Free))

    @cached_property
    def linear(self) -> bool:
        """Whether the density is linear in the displacement: its second derivatives vanish identically."""
        W, _, u = self._symbolic
        parts = [getattr(u, name) for name in self.parts]
        return all(isinstance(expand_derivatives(ufl.diff(ufl.diff(W, a), b)), Zero) for a in parts for b in parts)

    @cached_property
    def turns(self) -> bool:
        """Whether it, and what it observes, stays if shell and displacement turn about e3; at random jets."""

        def turned(jet: Array, angle: float) -> Array:
            c, s = np.cos(angle), np.sin(angle)
            return np.asarray(jet @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))

        return all(self._same((r0, u), (turned(r0, a), turned(u, a))) for a, (r0, u) in enumerate(_random_jets(), 1))

    def mirrored(self, mirror: Mirror) -> bool:
        """Whether it, and what it observes, stays if shell and displacement are mirrored; at random jets."""
        # the first coordinate changes places with the second, so that the normal stays outward
        order, S = [("r", *CURVED).index(name) for name in ("r", "r2", "r1", "r22", "r12", "r11")], mirror.reflection

        def image(r0: Array, u: Array) -> tuple[Array, Array]:
            return np.vstack([mirror.image(r0[:1]), r0[order[1:]] @ S]), u[order] @ S

        return all(self._same((r0, u), image(r0, u)) for r0, u in _random_jets())

    @property
    def digest(self) -> str:
        """A hash of its name, its amplitude and its values at random jets."""
        values = [self._value(r0, u, self.density) for r0, u in _random_jets()]
        free = [(p.name, p.value) for p in self.free]
        text = f"{self.name} {self.value!r} {free} {sorted(self.observed)} {[f'{v:.9e}' for v in values]}"
        text += " of a volume" * self.of_volume
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @cached_property
    def _symbolic(self) -> tuple[Expr, Jet, Jet]:
        """The density, and the jets of r0 and u that it is written with."""
        domain = ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,)))
        V = ufl.FunctionSpace(domain, basix.ufl.element("DG", "triangle", 0, shape=(3,)))
        r0, u = (Jet(*(ufl.variable(ufl.Coefficient(V)) for _ in range(1 + len(CURVED)))) for _ in range(2))
        try:
            return self._at(r0, u, self.density), r0, u
        except Exception as e:  # of any kind: the density is the user's own program
            said = f"{type(e).__name__}: {e}"
            raise ValueError(
                f"{self.name}: the density cannot be computed ({said}). It is a function of r0, u and "
                f"{len(self.parameters)} parameters, and returns a scalar made of r0.r, u.r, u.r1, ... by functions of "
                "UFL (ufl.dot, ufl.sqrt, ...) and of kinematics, not of NumPy or math"
            ) from e

    def _strangers(self) -> list[Expr]:
        """What else is in the density: fields, constants and coordinates of some mesh."""
        W, *jets = self._symbolic
        known = [part.ufl_operands[0] for jet in jets for part in jet.parts()]
        return [
            terminal
            for terminal in traverse_unique_terminals(W)
            if isinstance(terminal, Coefficient | Constant | GeometricQuantity) and terminal not in known
        ]

    def _found_in(self, jet: Jet) -> tuple[str, ...]:
        found = extract_coefficients(self._symbolic[0])
        return tuple(name for name in ("r", *CURVED) if getattr(jet, name).ufl_operands[0] in found)

    def _at(self, r0: Jet, u: Jet, density: Callable[..., Expr]) -> Expr:
        return ufl.as_ufl(density(r0, u, *(_as_expression(p) for p in self.parameters)))

    def _same(self, *pairs: tuple[Array, Array]) -> bool:
        """Whether the density, and each that is observed, is the same at two pairs of jets (6, 3)."""
        for density in (self.density, *self.observed.values()):
            here, there = (self._value(*pair, density) for pair in pairs)
            if not abs(here - there) <= SAME * max(abs(here), abs(there)):  # nan: no symmetry is known
                return False
        return True

    def _value(self, r0: Array, u: Array, density: Callable[..., Expr]) -> float:
        """A density at jets (6, 3); nan where it has none, as a root of less than zero."""
        try:
            return float(apply_algebra_lowering(self._at(_as_jet(r0), _as_jet(u), density))(()))
        except (ArithmeticError, TypeError, ValueError):
            return np.nan


def _random_jets() -> list[tuple[Array, Array]]:
    """Jets (6, 3) of r0 and u, always the same."""
    # within a box about as large as a shell
    return [(jets[0], jets[1] / 4) for jets in np.random.default_rng(2026).uniform(-1, 1, (SAMPLES, 2, 6, 3))]


def _as_jet(parts: Array) -> Jet:
    return Jet(*map(_as_expression, parts))


def _as_expression(value: float | Array | Free) -> Expr:
    if isinstance(value, Free):
        return ufl.as_ufl(value.value or 1.0)  # of no place in its range, such as zero, that hides terms
    return ufl.as_ufl(float(value)) if np.ndim(value) == 0 else ufl.as_tensor(np.asarray(value, dtype=float).tolist())
