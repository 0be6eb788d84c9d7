"""Readers take time in proportion to a file's size, whatever is in it."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from solver.errors import InputError
from solver.meshio.raw import read_raw
from solver.meshio.registered import REGISTERED_FORMATS, read_registered
from solver.registration.landmarks import read_landmarks
from solver.scans.live_link import read_live_link
from solver.scans.performance import open_performance
from solver.surface import Surface
from tests.campaigns.fuzz.growing import FILES

LEAST_SECONDS = 0.02  # a shorter time says nothing
MOST_GROWTH = 8.0  # of the time, from n to 4 n: caches cost a little, a square is 16
MOST = 100_000  # n with which a reader may still be too fast to be measured
REPETITIONS = (1, 3, 5, 9)  # of the timing, in turn while it says that time grows too fast
TRIANGLE = np.array([[0, 1, 2]])

pytestmark = pytest.mark.long


def play(path: Path) -> None:
    performance = open_performance(path, Surface(np.eye(3), TRIANGLE), np.arange(3))
    for number in range(len(performance)):
        performance.frame(number)


def readers(path: Path) -> list[Callable[[Path], object]]:
    if path.suffix == ".npy":
        return [play]
    if path.suffix in (".json", ".ljson"):
        return [read_landmarks]
    if path.suffix == ".csv":
        return [read_raw, read_landmarks, read_live_link]
    strict = [lambda path: read_registered(path, TRIANGLE, 3)]
    return [read_raw, *(strict if path.suffix in REGISTERED_FORMATS else [])]


def seconds(read: Callable[[Path], object], path: Path, times: int) -> float:
    """Return the least processor time of reading a file, whatever is wrong with it."""
    taken = []
    gc.disable()
    for _ in range(times):
        start = time.process_time()
        with suppress(InputError):
            read(path)
        taken.append(time.process_time() - start)
    gc.enable()
    return min(taken)


@pytest.mark.parametrize("name", FILES)
def test_time_grows_with_the_size_of_a_file(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    for read in readers(path):

        def timed(size: int, times: int, read: Callable[[Path], object] = read) -> float:
            path.write_bytes(FILES[name](size))
            return seconds(read, path, times)

        size = 1000
        while size < MOST and timed(size, 1) < LEAST_SECONDS:
            size *= 2
        if size < MOST:
            # a reader that grows as a square does so however often it is timed; a machine that is
            # busy with other things makes a long file dear only now and then
            for times in REPETITIONS:
                short = timed(size, times)
                long = timed(4 * size, times)
                if long <= MOST_GROWTH * short:
                    break
            assert long <= MOST_GROWTH * short, (size, short, long)
