"""The compose file and the image say the same as the code."""

from __future__ import annotations

from service.queue.wakeups import QUEUES, WEBHOOKS
from tests.campaigns.compose.described import ROOT, check_build_context, healthcheck, services
from tests.servers import UnavailableError, unavailable


def test_the_compose_file_is_valid_and_has_a_worker_for_each_queue() -> None:
    try:
        described = services()
    except UnavailableError as error:
        unavailable(str(error))
    commands = {" ".join(service.command) for service in described.values()}
    workers = {f"python -m worker {queue} --compile" for queue in QUEUES}
    assert workers | {f"python -m worker {WEBHOOKS}"} <= commands
    assert "python -m service" in commands


def test_the_build_context_has_what_the_image_needs() -> None:
    assert check_build_context() == []
    assert healthcheck()[0] == "python"
    locked = (ROOT / "locks/image.txt").read_text()
    assert "\nboto3==" in locked  # the compose file keeps files in S3
