"""What a history is at, for people who wait for it."""

from typing import Protocol

from magshell_fenicsx.continuation.point import Point


class Progress(Protocol):
    """Hears what is about to be done. No part of it is collective, and nothing may depend on it."""

    def trying(self, here: Point, length: float) -> None:
        """A step from an accepted point over a length of s."""

    def doing(self, what: str) -> None:
        """Something else that takes a while, in a few words."""


class NoProgress:
    """Nobody waits."""

    def trying(self, here: Point, length: float) -> None:
        pass

    def doing(self, what: str) -> None:
        pass
