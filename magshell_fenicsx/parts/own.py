"""What a case has besides its keys: where these were written, and energies that a program adds to it."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from pydantic import PrivateAttr

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.models.shell.own_term import OwnTerm


@dataclass(frozen=True)
class Origin:
    """Where the keys of a case were written, and what; equal cases may come from different files.

    Attributes
    ----------
    data
        Of `Source`; None without one.
    context
        With which these are validated: their folder and the files that were read.
    """

    place: Callable[[tuple[str | int, ...]], str] | None = field(default=None, compare=False)
    data: dict[str, Any] | None = field(default=None, compare=False, repr=False)
    context: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)


class WithOwnTerms(Section):
    """The base of a case."""

    _own_terms: tuple[OwnTerm, ...] = PrivateAttr(default=())
    _origin: Origin = PrivateAttr(default=Origin())

    def written_as(self, origin: Origin) -> Self:
        """The case, with the places of its keys for messages that it does not make itself."""
        self._origin = origin
        return self

    @property
    def origin(self) -> Origin:
        """Where and how it was written."""
        return self._origin

    @property
    def file_name(self) -> str:
        """Name of its case file; empty without one."""
        return Path(self._origin.place(())).name if self._origin.place else ""

    def placed(self, message: str) -> str:
        """A message that begins with a key of the case, with the place of this key before it.

        A name after the key, as that of a patch, is looked for below it.
        """
        about = re.match(r"([a-z]\w*(?:\.\w+)*): (?:([\w.]+): )?", message)
        if not (about and self._origin.place) or about[1].split(".")[0] not in type(self).model_fields:
            return message
        keys = [*about[1].split("."), *([about[2]] if about[2] else [])]
        return f"{self._origin.place(tuple(int(key) if key.isdecimal() else key for key in keys))}: {message}"

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
