"""Every job has an end: by its kind, by the installation, or by whoever asked for it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from myoface.stack import Stack
from service.settings import Settings
from solver.kinds import KINDS
from tests.servers.production import Production
from tests.service_client import Studio, running, served

SHORT = {"max_ingest_seconds": 10, "max_long_seconds": 12}


@pytest.fixture(scope="module")
def short_lived(
    parts: Production | None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Stack, Studio]]:
    with running(tmp_path_factory.mktemp("short"), **SHORT) as both:
        yield both


def test_a_check_that_takes_too_long_fails_and_lets_others_pass(
    short_lived: tuple[Stack, Studio],
) -> None:
    stack, studio = short_lived
    subject = studio.subject()
    endless = studio.raw(subject, "endless", seconds=600, fault="deaf")
    quick = studio.raw(subject, "quick")
    first = studio.submit("check_scan", subject, captures=[endless])
    second = studio.submit("check_scan", subject, captures=[quick])
    job = studio.finished(first, seconds=90)
    assert (job["state"], job["error"]["code"]) == ("failed", "job.timeout")
    assert job["error"]["seconds"] == 10
    assert [attempt["outcome"] for attempt in job["attempts"]] == ["failed"]
    assert studio.finished(second, seconds=90)["state"] == "succeeded"
    assert studio.solvers(stack) == []


def test_what_was_done_in_time_is_kept(short_lived: tuple[Stack, Studio]) -> None:
    _, studio = short_lived
    subject, rig_id = studio.rigged()
    scene = {"keys": [], "duration": 300, "fps": 30, "damping": 0.2}
    order = {"rig_id": rig_id, "options": {"scene": scene}}
    job = studio.finished(studio.submit("simulate", subject, **order), seconds=90)
    assert job["error"]["code"] == "job.timeout"
    assert job["error"]["frames"] > 4
    kept = studio.get(f"/v1/jobs/{job['id']}/frames")
    assert kept["ready"] == job["error"]["frames"]
    assert f"{kept['ready']} frames are kept" in job["error"]["message"]
    hurried = studio.submit("simulate", subject, deadline_s=1, **order)
    job = studio.finished(hurried, seconds=90)
    assert (job["deadline_s"], job["error"]["seconds"]) == (1, 1)
    assert job["error"]["code"] == "job.timeout"


def test_limits_are_shown(short_lived: tuple[Stack, Studio]) -> None:
    _, studio = short_lived
    limits = {each["kind"]: each["max_seconds"] for each in studio.get("/v1/kinds")["items"]}
    assert (limits["check_scan"], limits["build_model"], limits["simulate"]) == (10, 3600, 12)


def test_a_scene_that_nobody_would_live_to_see_is_refused(tmp_path: Path) -> None:
    scene = {"duration": 600, "fps": 240, "steps_per_frame": 64}
    with served(Settings(data_dir=tmp_path)) as studio:
        order = {"kind": "simulate", "subject_id": studio.subject(), "options": {"scene": scene}}
        answer = studio.http.post("/v1/jobs", json=order)
        assert (answer.status_code, answer.json()["code"]) == (422, "job.too_long")
        assert answer.json()["found"] == 9_216_000
        scene["steps_per_frame"] = 1
        assert studio.http.post("/v1/jobs", json=order).json()["code"] == "job.missing"


def test_large_files_have_more_time_unless_somebody_set_it(tmp_path: Path) -> None:
    check = KINDS["check_scan"]
    largest = 2 * 1024**3
    assert Settings(data_dir=tmp_path).max_seconds(KINDS["check_markers"]) == 300
    assert Settings(data_dir=tmp_path).max_seconds(KINDS["build_model"]) == 3600
    assert Settings(data_dir=tmp_path).max_seconds(check, 146_000) == 120
    assert Settings(data_dir=tmp_path).max_seconds(check, largest) == 120 + 2048
    assert Settings(data_dir=tmp_path, max_ingest_seconds=60).max_seconds(check, largest) == 60
