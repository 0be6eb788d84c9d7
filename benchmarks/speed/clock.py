"""Time and memory of a piece of work, as a user waits for it."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable
from typing import Self

import numpy as np

KIB_PER_GIB = 2**20


class Stopwatch:
    """``with Stopwatch() as watch``: afterwards ``watch.seconds`` is the wall time within."""

    seconds: float

    def __enter__(self) -> Self:
        self._start = time.perf_counter()
        return self

    def __exit__(self, *_exception: object) -> None:
        self.seconds = time.perf_counter() - self._start


class History:
    """The objective after each iteration and the ``clock``'s seconds until then: a listener.

    ``start`` is the objective before the first iteration, for solvers that do not tell it.
    """

    def __init__(self, clock: Callable[[], float], start: float | None = None) -> None:
        self._clock = clock
        self._began = clock()
        self.objective = [] if start is None else [start]
        self.seconds = [] if start is None else [0.0]

    def __call__(self, _iteration: int, objective: float) -> None:
        """Take an iteration's objective."""
        self.objective.append(objective)
        self.seconds.append(self._clock() - self._began)

    def until(self, share: float) -> float:
        """Return the seconds after which the objective stays within ``share`` of its end.

        NaN if it was told nothing.
        """
        if not self.objective:
            return float("nan")
        objective = np.asarray(self.objective)
        away = np.flatnonzero(np.abs(objective / objective[-1] - 1.0) > share)
        return self.seconds[away[-1] + 1 if len(away) else 0]


def peak_gib() -> float:
    """Return the most memory this process has held so far, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / KIB_PER_GIB
