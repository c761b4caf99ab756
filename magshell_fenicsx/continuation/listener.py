"""Reports of the status of a history, for the user."""

from typing import Protocol

from magshell_fenicsx.continuation.point import Point


class Progress(Protocol):
    """Receives the next action of a history. No method is collective, and no result may depend on it."""

    def trying(self, here: Point, length: float) -> None:
        """A step of a length in s from an accepted point begins."""

    def beginning(self, step: int) -> None:
        """A step of the programme begins at the last accepted point; its number is from 1."""

    def doing(self, what: str) -> None:
        """Some other long action begins; `what` describes it in a few words."""


class NoProgress:
    """Reports nothing."""

    def trying(self, here: Point, length: float) -> None:
        pass

    def beginning(self, step: int) -> None:
        pass

    def doing(self, what: str) -> None:
        pass
