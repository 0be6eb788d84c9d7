"""``python -m tests.campaigns.fuzz.child``: read hostile inputs with little memory and time.

A line of JSON on standard output for each target that stood; a traceback, the input that caused it
and exit status 1 for one that did not.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import signal
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.campaigns.fuzz.growing import NOT_BY_SIZE, growing
from tests.campaigns.fuzz.growth import GrowthOptions, measure_growth
from tests.campaigns.fuzz.large import LARGEST, large_inputs
from tests.campaigns.fuzz.mutations import mutated
from tests.campaigns.fuzz.targets import Target, targets

ROOM = 2 << 30
"""Bytes of address space that all inputs together may take, beyond what the readers' code needs."""
SECONDS = 5
"""For one input of at most 64 KB."""
SECONDS_PER_MB = 5
MB = 1 << 20


def main() -> None:
    """Hammer the targets named on the command line, or measure how their time grows."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.fuzz.child", description=__doc__
    )
    parser.add_argument("--inputs", type=int, required=True, help="small ones for each target")
    parser.add_argument("--large", type=int, required=True, help="large ones for each target")
    parser.add_argument("--growth", action="store_true", help="measure it, and nothing else")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("names", nargs="+")
    given_ = parser.parse_args()
    warnings.simplefilter("ignore", RuntimeWarning)  # of numpy, about what is then refused
    chosen = [target for target in targets() if target.name in given_.names]
    cap = _address_space() + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (cap, cap))
    signal.signal(signal.SIGPROF, _too_slow)
    with tempfile.TemporaryDirectory() as folder:
        for target in chosen:
            hammer = _Hammer(target, Path(folder))
            if given_.growth:
                told = hammer.growth()
            else:
                hammer.small(given_.inputs, given_.seed)
                hammer.large(given_.large, given_.seed)
                told = asdict(hammer.tally)
            sys.stdout.write(json.dumps({"target": target.name, **told}) + "\n")
            sys.stdout.flush()


@dataclass
class Tally:
    """Inputs of a target, and the dearest of them: its time and memory, and the bytes it had."""

    inputs: int = 0
    refused: int = 0
    largest: int = 0
    seconds: float = 0.0
    seconds_at: int = 0
    megabytes: float = 0.0
    megabytes_at: int = 0


@dataclass
class _Hammer:
    """Gives inputs to a target and counts."""

    target: Target
    folder: Path
    tally: Tally = field(default_factory=Tally)

    def small(self, inputs: int, number: int) -> None:
        """Give inputs of at most 64 KB, made by Hypothesis, which shrinks one that crashes."""

        @seed(number)
        @settings(
            max_examples=min(inputs, self.target.most_inputs or inputs),
            database=None,
            report_multiple_bugs=False,
            deadline=None,
            suppress_health_check=list(HealthCheck),
            phases=(Phase.generate, Phase.shrink),
        )
        @given(mutated(self.target.seeds))
        def once(content: bytes) -> None:
            self._give(content)

        self._telling(once)

    def large(self, inputs: int, number: int) -> None:
        """Give inputs of megabytes, and those that are made to cost the most, at their largest."""
        if not inputs:
            return
        for content in large_inputs(self.target.seeds, inputs, number):
            self._telling(partial(self._give, content))
        for make in growing(self.target.name).values():
            n = 1000
            while len(make(2 * n)) <= LARGEST and n < LARGEST:
                n *= 2
            self._telling(partial(self._give, make(n)))

    def growth(self) -> dict[str, object]:
        """Measure how the time grows; the worst of the inputs that are made for it."""
        if self.target.name in NOT_BY_SIZE:
            return {"factor": None}
        options = GrowthOptions(most_bytes=self.target.most_bytes)
        found = {
            name: measure_growth(self._read, make, options)
            for name, make in growing(self.target.name).items()
        }
        worst = max(found, key=lambda name: found[name].factor)
        all_of_it = {name: round(growth.factor, 2) for name, growth in found.items()}
        return {**asdict(found[worst]), "by": worst, "all": all_of_it}

    def _read(self, content: bytes) -> None:
        with suppress(self.target.refusal):
            self.target.run(content, self.folder)

    def _give(self, content: bytes) -> None:
        self._last = content
        Path("/proc/self/clear_refs").write_text("5")  # the peak of memory begins anew
        before = _memory("VmRSS")
        started = time.process_time()
        allowed = SECONDS + SECONDS_PER_MB * len(content) / MB
        signal.setitimer(signal.ITIMER_PROF, allowed)  # processor time: others may be at work
        refused = 0
        try:
            self.target.run(content, self.folder)
        except self.target.refusal:
            refused = 1
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        seconds = time.process_time() - started
        megabytes = _memory("VmHWM") - before
        self._count(len(content), refused, seconds, megabytes)

    def _count(self, size: int, refused: int, seconds: float, megabytes: float) -> None:
        tally = self.tally
        tally.inputs += 1
        tally.refused += refused
        tally.largest = max(tally.largest, size)
        if seconds > tally.seconds:
            tally.seconds = seconds
            tally.seconds_at = size
        if megabytes > tally.megabytes:
            tally.megabytes = megabytes
            tally.megabytes_at = size

    def _telling(self, work: Callable[[], None]) -> None:
        """Do some work; of a crash tell and keep the input."""
        try:
            work()
        except BaseException as error:
            error.__notes__ = []  # hypothesis repeats the whole input there
            name = self.target.name
            last = self._last
            kept = Path(tempfile.gettempdir()) / f"fuzz-{name.replace(' ', '-')}.crash"
            kept.write_bytes(last)
            sys.stderr.write(f"{name}: {last[:300]!r}, all {len(last)} bytes in {kept}\n")
            raise


def _memory(name: str) -> float:
    """Return a line of this process's status in MB."""
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return int(found[1]) / 1024


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def _too_slow(_number: int, _frame: FrameType | None) -> None:
    raise TimeoutError("an input took more than its time")


if __name__ == "__main__":
    main()
