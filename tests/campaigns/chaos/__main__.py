"""``python -m tests.campaigns.chaos``: many jobs under many blows; every one must end exactly once.

Seeded: the jobs, the blows and their order are those of the seed, only their timing is not. With
``--store postgresql+s3`` the same on servers that are started for it.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import structlog

from tests.campaigns.chaos import tally
from tests.campaigns.chaos.blows import BLOWS
from tests.campaigns.chaos.places import STORES
from tests.campaigns.chaos.stage import stage
from tests.servers import UnavailableError

OWN_MOUNTS = "MYOFACE_CHAOS_OWN_MOUNTS"
"""Set in the process that has its own view of what is mounted."""


def main() -> None:
    """Break things, then tell what became of the jobs."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.chaos", description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=60)
    parser.add_argument("--poison", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=2, help="so many times each kind of blow")
    parser.add_argument("--store", choices=sorted(STORES), default="sqlite")
    parser.add_argument(
        "--blows", nargs="+", choices=sorted(BLOWS), default=sorted(BLOWS), help="default: all"
    )
    given = parser.parse_args()
    if OWN_MOUNTS not in os.environ:
        _with_own_mounts()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(40))
    folder = Path(tempfile.mkdtemp(prefix="myoface-chaos-"))
    blows = given.rounds * given.blows
    try:
        fine = run(folder, given.store, given.seed, given.jobs, given.poison, blows)
    except UnavailableError as error:
        sys.exit(f"skipped: {error}")
    if fine:
        shutil.rmtree(folder)
        return
    sys.exit(f"seed {given.seed}; logs and tables are in {folder}")


def run(folder: Path, store: str, seed: int, jobs: int, poison: int, blows: list[str]) -> bool:
    """Strike ``blows`` while jobs run; returns whether every job ended as it should.

    One that misses, since its target has just died or ended, is tried once more.
    """
    began = time.monotonic()
    dice = random.Random(seed)
    order = dice.sample(blows, len(blows))
    with STORES[store](folder) as places, stage(folder, dice, places) as on_stage:
        on_stage.prepare(jobs, poison)
        told = tally.Tally(seed)
        for number, name in enumerate(order):
            on_stage.submit(-(-jobs * (number + 1) // len(order)))
            told.struck(name, BLOWS[name](on_stage) or BLOWS[name](on_stage))
            time.sleep(dice.uniform(0.2, 1.0))
        on_stage.submit(jobs)
        told.settle(on_stage)
    told.show(store, time.monotonic() - began)
    return told.is_fine


def _with_own_mounts() -> None:
    """Go on in a process whose small disks nobody else sees, and that vanish with it."""
    command = ["unshare", "--mount", *([] if os.geteuid() == 0 else ["--map-root-user"])]
    try:
        subprocess.run([*command, "true"], check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        return
    os.environ[OWN_MOUNTS] = "1"
    os.execvp(command[0], [*command, sys.executable, "-m", "tests.campaigns.chaos", *sys.argv[1:]])


if __name__ == "__main__":
    main()
