"""``python -m tests.campaigns.fuzz``: 20,000 hostile inputs to every reader, up to 8 MB large.

Prints what the dearest input of each cost, and how a reader's time grows from n to 4 n by the worst
of the inputs that are made for it. The exit status is 1 if one crashed, or if a time grows by more
than five.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from typer import echo as say

from tests.campaigns.fuzz.growth import MALLOC, GrowthOptions
from tests.campaigns.fuzz.targets import targets

SMALL_A_LARGE = 100
"""So many small inputs there are to one of megabytes."""


def main() -> int:
    """Print two tables; returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.fuzz", description=__doc__)
    parser.add_argument("--inputs", type=int, default=20_000, help="all together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--no-growth", action="store_true", help="do not measure times")
    parser.add_argument("names", nargs="*", help="targets, by default all")
    given = parser.parse_args()
    names = given.names or [target.name for target in targets()]
    each = -(-given.inputs // len(names))
    options = ["--seed", str(given.seed), "--inputs", str(each)]
    options += ["--large", str(-(-each // SMALL_A_LARGE))]
    crashed = _hammer(names, options, given.processes)
    steep = [] if given.no_growth else _grow(names, options)
    return 1 if crashed or steep else 0


def _hammer(names: Sequence[str], options: list[str], processes: int) -> list[str]:
    """Give each target its inputs; returns those that crashed."""
    total = 0
    largest = 0
    crashed = []
    head = f"{'reader':16} {'inputs':>7} {'refused':>8} {'largest':>8}"
    say(f"{head} {'worst s':>8} {'of KB':>6} {'worst MB':>9} {'of KB':>6}")
    for name, row in _rows(names, options, processes):
        if row is None:
            crashed.append(name)
            continue
        total += row["inputs"]
        largest = max(largest, row["largest"])
        say(
            f"{name:16} {row['inputs']:7} {row['refused']:8} {_kb(row['largest']):8} "
            f"{row['seconds']:8.2f} {_kb(row['seconds_at']):6} "
            f"{row['megabytes']:9.0f} {_kb(row['megabytes_at']):6}"
        )
    verdict = f"CRASHED: {', '.join(crashed)}" if crashed else "0 crashes"
    say(f"{total} hostile inputs, {verdict}; the largest had {largest} bytes")
    return crashed


def _grow(names: Sequence[str], options: list[str]) -> list[str]:
    """Measure each target's growth, one at a time; returns those that grow too much."""
    bar = GrowthOptions().bar
    steep = []
    say(f"\n{'reader':16} {'n to 4 n':>9} {'by':18} {'KB':>6} {'s at n':>8} {'at 4 n':>8}")
    for name, row in _rows(names, [*options, "--growth"], 1):
        if row is None or (row["factor"] or 0) > bar:
            steep.append(name)
        if row is None:
            continue
        if row["factor"] is None:
            say(f"{name:16} {'-':>9} its bytes choose a fault, and are not what is read")
            continue
        factor = f"{row['factor']:.1f}" if row["factor"] else "flat"
        times = f"{row['short']:8.3f} {row['long']:8.3f}"
        say(f"{name:16} {factor:>9} {row['by']:18} {_kb(row['size']):6} {times}")
    verdict = f"ABOVE: {', '.join(steep)}" if steep else "none above"
    say(f"growth from n to 4 n: {verdict}, the bar is {bar:g}")
    return steep


def _rows(
    names: Sequence[str], options: list[str], processes: int
) -> Iterator[tuple[str, dict[str, Any] | None]]:
    """Give the line that a process of each target left, None if it crashed."""

    def run(name: str) -> dict[str, Any] | None:
        command = [sys.executable, "-m", "tests.campaigns.fuzz.child", *options, name]
        own = os.environ | MALLOC
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False, env=own)
        found: dict[str, Any] | None = json.loads(done.stdout) if not done.returncode else None
        return found

    with ThreadPoolExecutor(processes) as pool:
        yield from zip(names, pool.map(run, names), strict=True)


def _kb(size: int) -> int:
    return -(-size // 1024)


if __name__ == "__main__":
    sys.exit(main())
