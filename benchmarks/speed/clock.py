"""Time and memory of a piece of work, as a user waits for it."""

from __future__ import annotations

import resource
import time
from typing import Self

KIB_PER_GIB = 2**20


class Stopwatch:
    """``with Stopwatch() as watch``: afterwards ``watch.seconds`` is the wall time within."""

    seconds: float

    def __enter__(self) -> Self:
        self._start = time.perf_counter()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.seconds = time.perf_counter() - self._start


def peak_gib() -> float:
    """Return the most memory this process has held so far, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIB_PER_GIB
