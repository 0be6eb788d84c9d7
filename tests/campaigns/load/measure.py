"""What a load run measures: answers by route, and the memory of the service's processes."""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

import httpx
import psutil

MB = 1024**2
READ = "GET"


class Answers:
    """The times of answers by route, in seconds; threads share one."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seconds: dict[str, list[float]] = defaultdict(list)
        self._errors: dict[str, list[str]] = defaultdict(list)

    @contextmanager
    def asking(self, route: str) -> Iterator[None]:
        """Measure one request; a refusal or a broken connection counts as an error."""
        started = time.perf_counter()
        try:
            yield
        except httpx.HTTPError as error:
            with self._lock:
                self._errors[route].append(repr(error))
        else:
            with self._lock:
                self._seconds[route].append(time.perf_counter() - started)

    def errors(self) -> list[str]:
        """Return what went wrong."""
        return [f"{route}: {each}" for route, found in self._errors.items() for each in found]

    def worst_read(self) -> float:
        """Return the largest p95 of the routes that only read, in seconds."""
        reads = [times for route, times in self._seconds.items() if route.startswith(READ)]
        return max((quantile(times, 0.95) for times in reads), default=0.0)

    def rows(self) -> list[list[str]]:
        """Return route, count, p50, p95, p99 and the longest in ms, and errors."""
        rows = []
        for route in sorted(self._seconds.keys() | self._errors.keys()):
            times = self._seconds.get(route, [])
            found = [quantile(times, each) for each in (0.5, 0.95, 0.99, 1)] if times else []
            cells = [f"{1000 * each:.0f}" for each in found] or ["-"] * 4
            rows.append([route, str(len(times)), *cells, str(len(self._errors.get(route, [])))])
        return rows


def quantile(values: Sequence[float], share: float) -> float:
    """Return the smallest value that at least ``share`` of them do not exceed."""
    ordered = sorted(values)
    return ordered[max(math.ceil(share * len(ordered)) - 1, 0)]


@dataclass
class Memory:
    """Resident memory of processes over time; ``pids`` is by name."""

    pids: dict[str, int]
    samples: dict[str, list[tuple[float, float]]] = field(default_factory=dict)

    def sample(self) -> None:
        """Write down the memory now, in MB."""
        for name, pid in self.pids.items():
            used = psutil.Process(pid).memory_info().rss / MB
            self.samples.setdefault(name, []).append((time.monotonic(), used))

    def slope(self, name: str) -> float:
        """Return how much it grows in the second half of the run, in MB a minute.

        Caches and thread pools fill in the first half.
        """
        points = self.samples[name][len(self.samples[name]) // 2 :]
        middle = sum(at for at, _ in points) / len(points)
        mean = sum(used for _, used in points) / len(points)
        spread = sum((at - middle) ** 2 for at, _ in points)
        rise = sum((at - middle) * (used - mean) for at, used in points)
        return 60 * rise / spread if spread else 0.0

    def rows(self) -> list[list[str]]:
        """Return name, MB at start, middle and end, and the slope."""
        rows = []
        for name, points in self.samples.items():
            picked = (points[0], points[len(points) // 2], points[-1])
            rows.append([name, *(f"{used:.0f}" for _, used in picked), f"{self.slope(name):+.1f}"])
        return rows


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return rows as aligned text, the first column to the left."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = []
    for row in (head, *rows):
        first, *rest = (cell.rjust(width) for cell, width in zip(row, widths, strict=True))
        lines.append("  ".join([row[0].ljust(len(first)), *rest]))
    return "\n".join(lines)
