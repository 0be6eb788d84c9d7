"""What docker-compose.yml describes, and a link between two hosts that breaks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from deploy.compose import check_build_context, healthcheck, services
from service.queue.wakeups import QUEUES, WEBHOOKS
from tests.servers import REQUIRED, UnavailableError, unavailable

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 300


def test_the_compose_file_is_valid_and_has_a_worker_for_each_queue() -> None:
    try:
        described = services()
    except UnavailableError as error:
        unavailable(str(error))
    commands = {" ".join(service.command) for service in described.values()}
    assert {f"python -m worker {queue}" for queue in (*QUEUES, WEBHOOKS)} <= commands
    assert "python -m service" in commands


def test_the_build_context_has_what_the_image_needs() -> None:
    assert check_build_context() == []
    assert healthcheck()[0] == "python"
    locked = (ROOT / "requirements-image.lock").read_text()
    assert "\nboto3==" in locked  # the compose file keeps files in S3


@pytest.mark.slow
@pytest.mark.servers
@pytest.mark.parametrize("show", [["deploy.check"], ["two_hosts", "--cut", "12"]], ids=str)
def test_the_show_runs(show: list[str]) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-m", *show],
        cwd=ROOT,
        env=environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    if "skipped:" in done.stdout:
        assert not os.environ.get(REQUIRED)
        pytest.skip(done.stdout.strip().splitlines()[-1])
