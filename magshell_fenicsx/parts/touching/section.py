"""The key `contact`: which shells may touch, and what a case with it can be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import Field

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.part import Account, Context, KeyAbility, Modelled
from magshell_fenicsx.shape.sections import MeshSurface
from magshell_fenicsx.shape.symmetry import Leaves

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.step import ProgrammeStep
    from magshell_fenicsx.shape.outline import Outline

Value = TypeVar("Value")
WHOLE = "shell"
KEEP_THICKNESS = ("koiter", "laminate")  # laws
STIFF = 1e6  # of the penalty, over D/(R h)^2, as that of a plane
Pairs = Annotated[
    list[Annotated[list[Annotated[str, Field(min_length=1, max_length=100)]], Field(min_length=2, max_length=2)]],
    Field(max_length=20),
]


@dataclass(frozen=True)
class Pair:
    """What may touch, dimensionless.

    Attributes
    ----------
    names
        Of both: `shell`, or a patch.
    suffix
        What its columns have at their ends.
    stiffness
        k of the penalty, over E h/R^2.
    bound
        Largest penetration that is allowed, over h.
    thickness
        The mean of both thicknesses over h.
    """

    names: tuple[str, str]
    suffix: str
    stiffness: float
    bound: float = 1e-3
    thickness: float = 1.0

    @property
    def setting(self) -> str:
        """Name of its stiffness in a state; no name of a user has a space."""
        return f"stiffness between {self.names[0]} and {self.names[1]}"

    @property
    def cuts(self) -> str:
        """Name in a state of the number of the displacement at which its cells were cut along each other."""
        return f"cuts between {self.names[0]} and {self.names[1]}"

    @property
    def words(self) -> str:
        """What it is, in messages."""
        return "the shell and itself" if self.names == ("shell", "shell") else " and ".join(self.names)


class ShellContact(KeyAbility[Sequence[Sequence[str]]]):
    """All pairs of a case that may touch."""

    key = "contact"

    def refuse_unfit(self, context: Context) -> None:
        refuse_unfit_pairs(self.given, context)

    def leaves(self, context: Context, outline: "Outline") -> list[Leaves]:
        """All planes: a half sees its image. The meridian where shells of constant thickness touch each other."""
        several = context.shell.assembly if isinstance(context.shell, MeshSurface) else None
        names, laws = {name for pair in self.given for name in pair}, several.laws if several else {}
        why = None
        if not names <= {*laws} or any(one == other for one, other in self.given):
            why = "contact: a shell that may touch itself is modelled with its circumference"
        elif any(laws[name] not in KEEP_THICKNESS for name in names):
            why = "contact: shells that get thinner as they stretch are modelled with their circumference"
        return [Leaves(why)]

    def adds(self, context: Context, modelled: Modelled) -> dict[str, Any]:
        several = context.shell.assembly if isinstance(context.shell, MeshSurface) else None
        thicknesses, moduli = (several.thicknesses, several.moduli) if several else ({}, {})
        return {"pairs": pairs(self.given, context.shell.poisson_ratio, thicknesses, moduli)}


def pairs(
    given: Sequence[Sequence[str]],
    nu: float,
    thickness: Mapping[str, float | None],
    moduli: Mapping[str, float] | None = None,
) -> tuple[Pair, ...]:
    """What a case's pairs are in a model.

    Parameters
    ----------
    thickness
        Of several shells: name -> thickness over h, None where it varies.
    moduli
        Of several shells: name -> Young's modulus over E; the penalty is that of the softer one.

    Raises
    ------
    CaseError
        If the faces of a pair are not one distance from their mid-surfaces.
    """
    k = STIFF / (12 * (1 - nu**2))
    several = len(given) > 1
    return tuple(
        Pair(
            (one, other),
            f"_{one}_{other}" if several else "",
            k * min([*_of_shells(one, moduli or {}), *_of_shells(other, moduli or {})], default=1.0),
            thickness=_mean(i, (one, other), thickness),
        )
        for i, (one, other) in enumerate(given)
    )


def _of_shells(name: str, values: Mapping[str, Value]) -> list[Value]:
    """The values of all shells, of the shell with this name, or of the shell that has this patch."""
    return [value for shell, value in values.items() if name in (WHOLE, shell) or name.startswith(f"{shell}_")]


def _mean(number: int, pair: Sequence[str], thickness: Mapping[str, float | None]) -> float:
    """The mean thickness of a pair over h; a patch is as thick as its shell."""
    found = list[float]()
    for name in pair if thickness else ():
        of = _of_shells(name, thickness)
        if None in of or len({*of}) > 1:
            raise CaseError(
                f"contact.{number}: {name}: needs the same thickness everywhere: leave out thickness_factor, and name "
                "shells of different thickness one by one"
            )
        found += [t for t in of[:1] if t is not None]
    return sum(found) / len(found) if found else 1.0


def refuse_unfit_pairs(given: Sequence[Sequence[str]], context: Context) -> None:
    """See that a model can have these contacts.

    Raises
    ------
    ValueError
        With the key and what is allowed.
    """
    seen, shells = set[frozenset[str]](), list(context.sections.get("shells") or {})
    for i, pair in enumerate(given):
        if frozenset(pair) in seen:
            raise ValueError(f"contact.{i}: {' and '.join(pair)}: a pair that stands twice; give each once")
        seen.add(frozenset(pair))
        for name in pair:
            if shells and name not in (WHOLE, *shells) and not name.startswith(tuple(f"{each}_" for each in shells)):
                raise ValueError(f"contact.{i}: {name}: there is no such shell, only {', '.join(shells)}")
            if name != WHOLE and not isinstance(context.shell, MeshSurface):
                raise ValueError(f"contact.{i}: {name}: allowed: {WHOLE}; parts are the patches of a mesh file")
    if len(seen) > 1 and frozenset({WHOLE}) in seen:
        raise ValueError(f"contact: {WHOLE} and itself has all other pairs: give it alone")
    context.needs("contact", "a mid-surface", "the same thickness everywhere")
    for step in context.steps:
        _refuse_step(step, context)


def _refuse_step(step: "ProgrammeStep", context: Context) -> None:
    if step.load.multiplies(step, context):
        said = f"{step.key}.kind: {step.kind}"
        raise ValueError(f"{said}: with contact, undeformed gaps would change: take steps along a path")


def account(context: Context, loads: "Loads") -> Account:
    """What may touch, and how stiff it is."""
    return Account(
        [
            f"contact of {pair.words} without friction, stiffness k R²/(E h) = {pair.stiffness:.4g}"
            for pair in loads.pairs
        ]
    )
