"""A stopwatch that adds up the time spent inside `with` blocks."""

import time
from types import TracebackType


class Stopwatch:
    """Attributes: seconds, summed over all blocks."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __enter__(self) -> None:
        self._start = time.perf_counter()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.seconds += time.perf_counter() - self._start
