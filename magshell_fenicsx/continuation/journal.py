"""A record of all results of a path, from which an interrupted history is repeated without solving."""

from typing import Protocol

from magshell_fenicsx.continuation.point import Point


class Journal(Protocol):
    """The results of `Path.recorded`, in their order.

    A history is deterministic: from the same results it chooses the same steps, targets and brackets. So the
    results are a complete checkpoint.
    """

    def replay(self) -> Point | str | None:
        """The next recorded result; None if there is none and a solve is needed.

        Collective. It may raise an exception to stop the history before a new solve begins.
        """

    def record(self, found: Point | str) -> None:
        """Keep a result. Collective."""

    def check(self, known: bool) -> None:
        """Between two steps in time towards one result, which may be `known` already. Collective.

        It may raise an exception to stop the history.
        """


class NoJournal:
    """Keeps nothing."""

    def replay(self) -> None:
        return None

    def record(self, found: Point | str) -> None:
        pass

    def check(self, known: bool) -> None:
        pass
