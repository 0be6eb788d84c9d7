"""Every campaign in small."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import pytest

from tests.servers import REQUIRED
from tests.service_client import ROOT

BLOWS = ["kill-worker", "kill-solver", "kill-broker", "fill-disk", "fill-database", "set-clock"]
BLOWS += ["hold-lock", "kill-backup", "flip-file", "lose-file"]


def run(campaign: str, *options: str, seconds: float = 300) -> str:
    """Return what a campaign prints; fails unless it ends with exit status 0."""
    done = subprocess.run(
        [sys.executable, "-m", f"tests.campaigns.{campaign}", *options],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_every_job_ends_exactly_once() -> None:
    small = ["--seed", "7", "--jobs", "12", "--poison", "1", "--rounds", "1"]
    run("chaos", *small, "--blows", *BLOWS, seconds=240)


@pytest.mark.slow
def test_no_reader_of_hostile_inputs_crashes() -> None:
    printed = run("fuzz", "--inputs", "2400", "--seed", "7", "--no-growth")
    total = re.search(r"(\d+) hostile inputs, 0 crashes", printed)
    assert total
    assert int(total[1]) >= 2000, printed


@pytest.mark.slow
def test_a_crowd_of_slow_clients_takes_nothing_from_a_customer() -> None:
    printed = run("slow_clients", "--clients", "600", "--seconds", "10")
    assert printed.count(" 0 refused") == 2


@pytest.mark.slow
@pytest.mark.servers
@pytest.mark.parametrize("campaign", [["compose"], ["two_hosts", "--cut", "12"]], ids=str)
def test_the_show_runs(campaign: list[str]) -> None:
    printed = run(*campaign)
    if "skipped:" in printed:
        assert not os.environ.get(REQUIRED)
        pytest.skip(printed.strip().splitlines()[-1])
