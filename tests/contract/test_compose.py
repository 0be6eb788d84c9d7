"""The compose file and the image say the same as the code."""

from __future__ import annotations

import re

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


def test_no_secret_is_in_the_description_of_a_container() -> None:
    """What an inspection of containers or a list of processes shows has names of files only."""
    text = (ROOT / "docker-compose.yml").read_text()
    made = (ROOT / "deploy" / "make-secrets").read_text()
    named = set(re.findall(r"/run/secrets/(\w+)", text))
    assert named == set(re.findall(r"\{file: ./deploy/secrets/(\w+)\}", text))
    assert named == set(re.findall(r"^keep (\w+)", made, re.MULTILINE))
    assert "_PASSWORD:" not in text
    assert "requirepass" not in text


def test_every_container_is_confined() -> None:
    try:
        described = services()
    except UnavailableError as error:
        unavailable(str(error))
    for name, service in described.items():
        assert service.described["read_only"] is True, name
        assert service.described["cap_drop"] == ["ALL"], name
        assert service.described["security_opt"] == ["no-new-privileges:true"], name
        assert service.described["pids_limit"] > 0, name
        if name not in ("api", "first-key"):  # the image has the API's; the other one ends
            assert service.health, name
    solvers = [described[f"worker-{queue}"].described for queue in QUEUES]
    for each in solvers:
        assert "volumes" not in each
        assert "secret_key" not in str(each["secrets"])
