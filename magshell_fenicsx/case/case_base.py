"""The base of a case: where it was written, the energies of programs, and the keys of parts.

A part is a section of a case with a key of its own, which the registry gives. Own terms are
energies that a program adds to a case.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from pydantic import Field, PrivateAttr, create_model

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.ability import Part
from magshell_fenicsx.parts.registered import PART_CLASSES


@dataclass(frozen=True)
class Origin:
    """The places where the keys of a case were written, and its data.

    Origins do not count when cases are compared: equal cases may come from different files.

    Attributes
    ----------
    place
        Location (keys that lead to a value) -> place in the file; None without a file.
    data
        Plain data of the case, as of `Source`; None without a file.
    context
        Context with which the data are validated: the folder of the case and the files that were
        read.
    """

    place: Callable[[tuple[str | int, ...]], str] | None = field(default=None, compare=False)
    data: dict[str, Any] | None = field(default=None, compare=False, repr=False)
    context: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)


class CaseBase(Section):
    """The base of a case."""

    _own_terms: tuple[OwnTerm, ...] = PrivateAttr(default=())
    _origin: Origin = PrivateAttr(default=Origin())

    def written_as(self, origin: Origin) -> Self:
        """Set the origin of the case, for messages that others make, and return the case."""
        self._origin = origin
        return self

    @property
    def origin(self) -> Origin:
        """The places where the case was written, and its data."""
        return self._origin

    @property
    def file_name(self) -> str:
        """The name of its case file; empty without one."""
        return Path(self._origin.place(())).name if self._origin.place else ""

    def with_place(self, message: str) -> str:
        """Return a message that begins with a key of the case, after the place of the key.

        A name after the key, such as that of a patch, is looked up below the key. Other messages
        are returned unchanged.
        """
        # "key.below: name: ..." or "key.below: ..."
        match = re.match(r"([a-z]\w*(?:\.\w+)*): (?:([\w.]+): )?", message)
        if not (match and self._origin.place):
            return message
        keys, name = match[1].split("."), match[2]
        if keys[0] not in type(self).model_fields:
            return message
        if name:
            keys.append(name)
        # numbers are positions in lists
        location = tuple(int(key) if key.isdecimal() else key for key in keys)
        return f"{self._origin.place(location)}: {message}"

    @property
    def own_terms(self) -> tuple[OwnTerm, ...]:
        """The user-defined energies, which every problem and scene of the case has."""
        return self._own_terms

    def with_terms(self, terms: Sequence[OwnTerm]) -> Self:
        """Return a copy of the case with user-defined energies, to be used as any other case."""
        copied = self.model_copy()
        copied._own_terms = tuple(terms)
        return copied

    @property
    def term_digests(self) -> dict[str, str | None]:
        """Hashes of the user-defined energies, by which a resumed run is recognised."""
        return {f"terms.{term.name}": term.digest for term in self._own_terms}


def _meaning(part: type[Part]) -> str:
    """Return the first sentence of a part's docstring."""
    return cleandoc(part.__doc__ or "").split(".")[0]


if TYPE_CHECKING:
    WithParts = CaseBase
else:  # an optional key for each part
    WithParts = create_model(
        "WithParts",
        __base__=CaseBase,
        **{
            key: (part | None, Field(default=None, description=_meaning(part)))
            for key, part in PART_CLASSES.items()
        },
    )
