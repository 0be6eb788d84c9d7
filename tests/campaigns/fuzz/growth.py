"""Growth of a reader's time with the size of what it reads, measured so that caches do not count.

The time of an input so small that only the start costs is taken off; each size is read several
times in turn, and the least processor time counts. A linear reader takes four times as long from n
to 4 n, a square one sixteen. Where the larger of the two falls out of a cache, a linear one takes
up to six times as long: so there are up to three windows, each of twice the size, and the least
growth counts. A square has sixteen in all. `MALLOC` is for the environment of the process.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass

from tests.campaigns.fuzz.growing import Make

# Else the C library keeps blocks of some megabytes for their next use, and larger ones it does not
MALLOC = {"MALLOC_MMAP_THRESHOLD_": str(1 << 16)}


@dataclass(frozen=True)
class GrowthOptions:
    """Options of measuring a growth."""

    least_seconds: float = 0.06  # of the smaller input, where there is so large a one
    negligible: float = 0.03  # s of the largest input, below which nothing can be measured
    most_bytes: int = 32 << 20  # of the larger input
    most_seconds: float = 20.0  # of the larger input, with which the next window would begin
    first: int = 500  # n to begin with
    repetitions: int = 4
    bar: float = 5.0  # growth above which the next window is tried
    windows: int = 3


@dataclass(frozen=True)
class Growth:
    """Growth from ``size`` bytes to four times n, with both times in seconds; 0: not to be seen."""

    factor: float
    size: int
    short: float
    long: float


def measure_growth(
    read: Callable[[bytes], object], make: Make, options: GrowthOptions | None = None
) -> Growth:
    """Return how a reader's time grows with the n of what is made for it."""
    given = options or GrowthOptions()
    fixed = _seconds(read, [make(1)], given.repetitions)[0]
    n = given.first
    while (
        _seconds(read, [make(n)], 1)[0] - fixed < given.least_seconds
        and 8 * len(make(n)) <= given.most_bytes
    ):
        n *= 2
    found: list[Growth] = []
    for _ in range(given.windows):
        contents = [make(n), make(4 * n)]
        if found and len(contents[1]) > given.most_bytes:
            break
        short, long = (seconds - fixed for seconds in _seconds(read, contents, given.repetitions))
        if long < given.negligible:
            return Growth(0.0, len(contents[0]), max(short, 0.0), max(long, 0.0))
        found.append(Growth(long / max(short, 1e-9), len(contents[0]), short, long))
        if found[-1].factor <= given.bar or long > given.most_seconds:
            break
        n *= 2
    return min(found, key=lambda growth: growth.factor)


def _seconds(
    read: Callable[[bytes], object], contents: list[bytes], repetitions: int
) -> list[float]:
    """Return the least processor time of reading each of some contents, in turn."""
    least = [float("inf")] * len(contents)
    gc.freeze()  # what the imports made need not be looked through
    gc.disable()
    try:
        for _ in range(repetitions):
            for number, content in enumerate(contents):
                started = time.process_time()
                read(content)
                least[number] = min(least[number], time.process_time() - started)
                gc.collect()
    finally:
        gc.enable()
    return least
