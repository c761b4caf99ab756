"""The section `contact` of a case: which shells may touch, and what a case with contact can be.

A pair has two members that may touch: shells, patches of one, or a shell and itself; the name
`shell` stands for all of a case's shell. A penalty keeps them apart. E, h, R and D are modulus,
thickness, reference length and bending stiffness of the shell. A step of a case drives one load.
In goes the section, out come the pairs of a model (`Pair`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pydantic import Discriminator, Field, Tag

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.parts.ability import Context, KeyAbility, Modelled
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, patch_constraint

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.step import ProgrammeStep
    from magshell_fenicsx.shape.outline import Outline

WHOLE_SHELL = "shell"
RELATIVE_STIFFNESS = 1e6  # of the penalty by default, over D/(R h)^2, as of a plane
TwoNames = Annotated[
    list[Annotated[str, Field(min_length=1, max_length=100)]], Field(min_length=2, max_length=2)
]


class PairSection(Section):
    """A pair of `contact` with more than its names."""

    between: TwoNames
    """What may touch"""
    stiffness: float | None = Field(default=None, gt=0, le=1e12)
    """k of the penalty k s²/2 per area of a penetration s; by default 1e6 D/(R² h²), and four times
    as much each time that the penetration would exceed 1e-3 h, in a motion 0.1 h for a moment; a
    given one stays, and the run stops where the penetration is more [E h/R²]"""


GivenPair = Annotated[
    Annotated[TwoNames, Tag("a pair")] | Annotated[PairSection, Tag("a pair with keys")],
    Discriminator(
        lambda data: "a pair with keys" if isinstance(data, dict | PairSection) else "a pair"
    ),
]
Pairs = Annotated[list[GivenPair], Field(max_length=20)]


def names_of(pair: GivenPair) -> list[str]:
    """Return the names of both members of a pair of the case."""
    return pair.between if isinstance(pair, PairSection) else pair


@dataclass(frozen=True)
class Pair:
    """Two shells or patches that may touch, dimensionless.

    Attributes
    ----------
    names
        Names of both: `shell`, or a patch.
    suffix
        End of the names of its columns.
    stiffness
        Stiffness k of the penalty, over E h/R^2.
    max_penetration
        Largest penetration that is allowed, over the thickness there.
    has_given_stiffness
        Whether the case gives the stiffness, which then stays.
    """

    names: tuple[str, str]
    suffix: str
    stiffness: float
    max_penetration: float = 1e-3
    has_given_stiffness: bool = False

    def has(self, shell: str) -> bool:
        """Return whether a shell is in the pair; `shell` stands for the name of one of several."""
        return shell in self.names or WHOLE_SHELL in self.names

    @property
    def setting(self) -> str:
        """The name under which a state stores the stiffness; no name of a user has a space."""
        return f"stiffness between {self.names[0]} and {self.names[1]}"

    @property
    def cuts(self) -> str:
        """The name under which a state stores the number of its cuts.

        Cuts divide cells along the cells that they face.
        """
        return f"cuts between {self.names[0]} and {self.names[1]}"

    @property
    def words(self) -> str:
        """The pair in messages, such as "top and bottom"."""
        return (
            "the shell and itself" if self.names == ("shell", "shell") else " and ".join(self.names)
        )


class ShellContact(KeyAbility[Sequence[GivenPair]]):
    """All pairs of a case that may touch."""

    key = "contact"

    def refuse_unfit(self, context: Context) -> None:
        """Refuse pairs that the model of the case cannot have.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """
        refuse_unfit_pairs(self.sections, context)

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that contact preserves: all of it, unless a patch may touch.

        A patch need not be the same all around an axis; then the case has no meridian model. The
        outline is not used here.
        """
        names = {name for pair in self.sections for name in names_of(pair)} - {WHOLE_SHELL}
        assembly = context.shell.assembly if isinstance(context.shell, MeshSurface) else None
        return [patch_constraint("contact", names, assembly)]

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the pairs that may touch, dimensionless."""
        from magshell_fenicsx.parts.loads import Loads  # the solver takes long to import

        # several shells, each with a modulus of its own; only a mesh can have them
        assembly = context.shell.assembly if isinstance(context.shell, MeshSurface) else None
        moduli = assembly.moduli if assembly else {}
        return Loads(pairs=model_pairs(self.sections, context.shell.poisson_ratio, moduli))


def model_pairs(
    sections: Sequence[GivenPair], nu: float, moduli: Mapping[str, float]
) -> tuple[Pair, ...]:
    """Return the pairs of a case as a model needs them, with the stiffness of their penalties.

    The default stiffness is that of a plane, times the modulus of the softer shell.

    Parameters
    ----------
    sections
        The pairs of the case.
    nu
        Poisson's ratio.
    moduli
        Name of each of several shells -> Young's modulus over E; empty for one shell.
    """
    # stiffnesses are over E h/R^2, and D/(R h)^2 is E h/R^2 over 12 (1 - nu^2)
    default_stiffness, pairs = RELATIVE_STIFFNESS / (12 * (1 - nu**2)), list[Pair]()
    for pair in sections:
        first, second = names_of(pair)
        moduli_of_pair = [_values_of_shells(name, moduli) for name in (first, second)]
        # of one shell there are no moduli: its own is E
        softer_modulus = min([*moduli_of_pair[0], *moduli_of_pair[1]], default=1.0)
        given_stiffness = pair.stiffness if isinstance(pair, PairSection) else None
        # columns of a single pair need no names to tell pairs apart
        suffix = f"_{first}_{second}" if len(sections) > 1 else ""
        stiffness = given_stiffness or default_stiffness * softer_modulus
        is_given = given_stiffness is not None
        pairs.append(Pair((first, second), suffix, stiffness, has_given_stiffness=is_given))
    return tuple(pairs)


def _values_of_shells(name: str, values: Mapping[str, float]) -> list[float]:
    """Return the values of the shells that a name stands for.

    The name is that of all (`WHOLE_SHELL`), of one shell, or of a patch "SHELL_...".

    Parameters
    ----------
    values
        Name of each shell -> value.
    """
    return [
        value
        for shell, value in values.items()
        if name in (WHOLE_SHELL, shell) or name.startswith(f"{shell}_")
    ]


def refuse_unfit_pairs(sections: Sequence[GivenPair], context: Context) -> None:
    """Check that a model can have contact of these pairs.

    Raises
    ------
    ValueError
        With the key and what is allowed.
    """
    # earlier pairs as sets, since the order of their members does not matter; names of several
    # shells, if there are any
    earlier_pairs, shells = set[frozenset[str]](), list(context.sections.get("shells") or {})
    for i, pair in enumerate(map(names_of, sections)):
        if frozenset(pair) in earlier_pairs:
            raise ValueError(
                f"contact.{i}: {' and '.join(pair)}: a pair that stands twice; give each once"
            )
        earlier_pairs.add(frozenset(pair))
        for name in pair:
            # if there are several shells, a name is that of one of them, or of a patch of one
            is_shell = name in (WHOLE_SHELL, *shells)
            is_patch = name.startswith(tuple(f"{shell}_" for shell in shells))
            is_known = is_shell or is_patch
            if shells and not is_known:
                raise ValueError(
                    f"contact.{i}: {name}: there is no such shell, only {', '.join(shells)}"
                )
            if name != WHOLE_SHELL and not isinstance(context.shell, MeshSurface):
                raise ValueError(
                    f"contact.{i}: {name}: allowed: {WHOLE_SHELL}; parts are the patches of a "
                    "mesh file"
                )
    # the pair of the whole shell and itself, whose set has one name, must be the only pair
    if len(earlier_pairs) > 1 and frozenset({WHOLE_SHELL}) in earlier_pairs:
        raise ValueError(f"contact: {WHOLE_SHELL} and itself has all other pairs: give it alone")
    context.needs("contact", "a mid-surface")
    for step in context.steps:
        _refuse_step(step)


def _refuse_step(step: "ProgrammeStep") -> None:
    """Refuse a step that multiplies imperfections, since undeformed gaps would change.

    Raises
    ------
    ValueError
        With the key of the step.
    """
    if step.load.changes_gaps:
        key = f"{step.key}.kind: {step.kind}"
        raise ValueError(
            f"{key}: with contact, undeformed gaps would change: take steps along a path"
        )
