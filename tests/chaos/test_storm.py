"""``python -m chaos`` in small: each job ends exactly once."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.service_client import ROOT

SMALL = ["--seed", "7", "--jobs", "12", "--poison", "1", "--rounds", "1"]
BLOWS = ["kill-worker", "kill-solver", "kill-broker", "empty-broker", "fill-disk"]


@pytest.mark.slow
def test_every_job_ends_exactly_once() -> None:
    command = [sys.executable, "-m", "chaos", *SMALL, "--blows", *BLOWS]
    done = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
