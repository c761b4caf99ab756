"""A record of everything a path solved for, from which an interrupted history is retraced without solving."""

from typing import Protocol

from magshell_fenicsx.continuation.point import Point


class Journal(Protocol):
    """The results of `Path.solve`, in the order in which they came.

    A history is deterministic: given the same results again, it chooses the same steps, targets and
    brackets. So the results are a complete checkpoint.
    """

    def replay(self) -> Point | str | None:
        """The next result on record; None where there is none and it must be solved for.

        Collective. May raise, to stop the history here: a new solve would begin.
        """

    def record(self, found: Point | str) -> None:
        """Keep a result. Collective."""


class NoJournal:
    """Keeps nothing."""

    def replay(self) -> None:
        return None

    def record(self, found: Point | str) -> None:
        pass
