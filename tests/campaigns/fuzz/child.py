"""``python -m tests.campaigns.fuzz.child``: read hostile inputs with little memory and time.

One line of JSON on standard output for each target that stood; a traceback, the input that
caused it and exit status 1 for one that did not.
"""

from __future__ import annotations

import argparse
import json
import resource
import signal
import sys
import tempfile
import warnings
from pathlib import Path
from types import FrameType

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.campaigns.fuzz.mutations import mutated
from tests.campaigns.fuzz.targets import Target, targets

ROOM = 1 << 30
"""Bytes of address space that all inputs together may take, beyond what the readers' code needs."""
SECONDS = 5
"""For one input of at most 64 KB."""


def main() -> None:
    """Hammer the targets named on the command line, or all."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.fuzz.child", description=__doc__
    )
    parser.add_argument("--inputs", type=int, required=True, help="for each target")
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("names", nargs="*")
    given_ = parser.parse_args()
    warnings.simplefilter("ignore", RuntimeWarning)  # of numpy, about what is then refused
    chosen = [target for target in targets() if target.name in (given_.names or [target.name])]
    cap = _address_space() + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (cap, cap))
    signal.signal(signal.SIGALRM, _too_slow)
    with tempfile.TemporaryDirectory() as folder:
        for target in chosen:
            sys.stdout.write(json.dumps(_hammer(target, given_.inputs, given_.seed, folder)) + "\n")
            sys.stdout.flush()


def _hammer(target: Target, inputs: int, number: int, folder: str) -> dict[str, object]:
    tally = {"inputs": 0, "refused": 0}
    last = b""

    @seed(number)
    @settings(
        max_examples=inputs,
        database=None,
        report_multiple_bugs=False,
        deadline=None,
        suppress_health_check=list(HealthCheck),
        phases=(Phase.generate, Phase.shrink),
    )
    @given(mutated(target.seeds))
    def once(content: bytes) -> None:
        nonlocal last
        last = content
        tally["inputs"] += 1
        signal.alarm(SECONDS)
        try:
            target.run(content, Path(folder))
        except target.refusal:
            tally["refused"] += 1
        finally:
            signal.alarm(0)

    try:
        once()
    except BaseException as error:
        error.__notes__ = []  # hypothesis repeats the whole input there
        kept = Path(tempfile.gettempdir()) / f"fuzz-{target.name.replace(' ', '-')}.crash"
        kept.write_bytes(last)
        sys.stderr.write(f"{target.name}: {last[:300]!r}, all {len(last)} bytes in {kept}\n")
        raise
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    return {"target": target.name, **tally, "peak_mb": peak}


def _address_space() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    return pages * resource.getpagesize()


def _too_slow(_number: int, _frame: FrameType | None) -> None:
    raise TimeoutError(f"an input took more than {SECONDS} s")


if __name__ == "__main__":
    main()
