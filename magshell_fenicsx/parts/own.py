"""A case's user-defined energies, which a program adds to it and no file can."""

from collections.abc import Sequence
from typing import Self

from pydantic import PrivateAttr

from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.section import Section


class WithOwnTerms(Section):
    """The base of a case."""

    _own_terms: tuple[OwnTerm, ...] = PrivateAttr(default=())

    @property
    def own_terms(self) -> tuple[OwnTerm, ...]:
        """The user-defined energies; what is made of the case has them."""
        return self._own_terms

    def with_terms(self, terms: Sequence[OwnTerm]) -> Self:
        """A copy of the case with these energies, for `run`, `Scene` and whatever else takes a case."""
        copied = self.model_copy()
        copied._own_terms = tuple(terms)
        return copied

    @property
    def term_digests(self) -> dict[str, str | None]:
        """Hashes of the energies, by which a run is recognised that is resumed."""
        return {f"terms.{term.name}": term.digest for term in self._own_terms}
