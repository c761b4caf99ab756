"""The key `contact`: which shells may touch, and what a case with it can be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Discriminator, Field, Tag

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.parts.part import Account, Context, KeyAbility, Modelled
from magshell_fenicsx.shape.shell_sections import MeshSurface
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, patch_constraint

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.step import ProgrammeStep
    from magshell_fenicsx.shape.outline import Outline

WHOLE = "shell"
STIFF = 1e6  # of the penalty, over D/(R h)^2, as that of a plane
Both = Annotated[
    list[Annotated[str, Field(min_length=1, max_length=100)]], Field(min_length=2, max_length=2)
]


class PairSection(Section):
    """A pair of `contact` with more than its names."""

    between: Both
    """What may touch"""
    stiffness: float | None = Field(default=None, gt=0, le=1e12)
    """k of the penalty k s²/2 per area of a penetration s; by default 1e6 D/(R² h²), and four times as much each time
    that the penetration would exceed 1e-3 h, in a motion 0.1 h for a moment; a given one stays, and the run stops where
    the penetration is more [E h/R²]"""


GivenPair = Annotated[
    Annotated[Both, Tag("a pair")] | Annotated[PairSection, Tag("a pair with keys")],
    Discriminator(
        lambda data: "a pair with keys" if isinstance(data, dict | PairSection) else "a pair"
    ),
]
Pairs = Annotated[list[GivenPair], Field(max_length=20)]


def names_in(pair: GivenPair) -> list[str]:
    """Of a pair as a case has it."""
    return pair.between if isinstance(pair, PairSection) else pair


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
        Largest penetration that is allowed, over the thickness there.
    given
        Whether the case gives its stiffness, which then stays.
    """

    names: tuple[str, str]
    suffix: str
    stiffness: float
    bound: float = 1e-3
    given: bool = False

    def has(self, shell: str) -> bool:
        """Whether one of several shells with this name may touch."""
        return shell in self.names or WHOLE in self.names

    @property
    def setting(self) -> str:
        """Name of its stiffness in a state; no name of a user has a space."""
        return f"stiffness between {self.names[0]} and {self.names[1]}"

    @property
    def cuts(self) -> str:
        """Name in a state of the number of the displacement at which its cells were cut along each
        other.
        """
        return f"cuts between {self.names[0]} and {self.names[1]}"

    @property
    def words(self) -> str:
        """What it is, in messages."""
        return (
            "the shell and itself" if self.names == ("shell", "shell") else " and ".join(self.names)
        )


class ShellContact(KeyAbility[Sequence[GivenPair]]):
    """All pairs of a case that may touch."""

    key = "contact"

    def refuse_unfit(self, context: Context) -> None:
        refuse_unfit_pairs(self.given, context)

    def leaves(self, context: Context, outline: "Outline") -> list[SymmetryConstraint]:
        """All, but no meridian of a part of a shell."""
        names = {name for pair in self.given for name in names_in(pair)} - {WHOLE}
        return [patch_constraint("contact", names, context.shell)]

    def adds(self, context: Context, modelled: Modelled) -> dict[str, Any]:
        several = context.shell.assembly if isinstance(context.shell, MeshSurface) else None
        return {
            "pairs": pairs(
                self.given, context.shell.poisson_ratio, several.moduli if several else {}
            )
        }


def pairs(given: Sequence[GivenPair], nu: float, moduli: Mapping[str, float]) -> tuple[Pair, ...]:
    """What a case's pairs are in a model.

    Parameters
    ----------
    moduli
        Of several shells: name -> Young's modulus over E; the penalty is that of the softer one.
    """
    k, made = STIFF / (12 * (1 - nu**2)), list[Pair]()
    for pair in given:
        one, other = names_in(pair)
        softer = min([*_of_shells(one, moduli), *_of_shells(other, moduli)], default=1.0)
        own = pair.stiffness if isinstance(pair, PairSection) else None
        suffix = f"_{one}_{other}" if len(given) > 1 else ""
        made.append(Pair((one, other), suffix, own or k * softer, given=own is not None))
    return tuple(made)


def _of_shells(name: str, values: Mapping[str, float]) -> list[float]:
    """The values of all shells, of the shell with this name, or of the shell that has this patch."""
    return [
        value
        for shell, value in values.items()
        if name in (WHOLE, shell) or name.startswith(f"{shell}_")
    ]


def refuse_unfit_pairs(given: Sequence[GivenPair], context: Context) -> None:
    """See that a model can have these contacts.

    Raises
    ------
    ValueError
        With the key and what is allowed.
    """
    seen, shells = set[frozenset[str]](), list(context.sections.get("shells") or {})
    for i, pair in enumerate(map(names_in, given)):
        if frozenset(pair) in seen:
            raise ValueError(
                f"contact.{i}: {' and '.join(pair)}: a pair that stands twice; give each once"
            )
        seen.add(frozenset(pair))
        for name in pair:
            if (
                shells
                and name not in (WHOLE, *shells)
                and not name.startswith(tuple(f"{each}_" for each in shells))
            ):
                raise ValueError(
                    f"contact.{i}: {name}: there is no such shell, only {', '.join(shells)}"
                )
            if name != WHOLE and not isinstance(context.shell, MeshSurface):
                raise ValueError(
                    f"contact.{i}: {name}: allowed: {WHOLE}; parts are the patches of a mesh file"
                )
    if len(seen) > 1 and frozenset({WHOLE}) in seen:
        raise ValueError(f"contact: {WHOLE} and itself has all other pairs: give it alone")
    context.needs("contact", "a mid-surface")
    for step in context.steps:
        _refuse_step(step, context)


def _refuse_step(step: "ProgrammeStep", context: Context) -> None:
    if step.load.multiplies(step, context):
        said = f"{step.key}.kind: {step.kind}"
        raise ValueError(
            f"{said}: with contact, undeformed gaps would change: take steps along a path"
        )


def account(context: Context, loads: "Loads") -> Account:
    """What may touch, and how stiff it is."""
    return Account(
        [
            f"contact of {pair.words} without friction, stiffness k R²/(E h) = {pair.stiffness:.4g}"
            + (", as given" if pair.given else "")
            for pair in loads.pairs
        ]
    )
