"""The life of a job through the real API, broker, workers and solver processes."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from myoface.stack import Stack
from tests.service_client import Studio, eventually, running


@pytest.fixture
def studio(stack_and_studio: tuple[Stack, Studio]) -> Studio:
    return stack_and_studio[1]


@pytest.mark.telling
def test_scans_become_a_rig_and_a_child_rig(studio: Studio) -> None:
    subject = studio.modelled()
    smile = studio.capture(subject, "smile")
    pucker = studio.capture(subject, "pucker")
    first = studio.finished(studio.submit("fit_geometry", subject, captures=[smile]))
    assert first["state"] == "succeeded", first
    assert [a["name"] for a in first["result"]["artifacts"]] == [
        "activations.npz",
        "muscle_weights.npz",
        "report.html",
        "report.json",
        "rig.glb",
        "rig.npz",
    ]
    assert [a["outcome"] for a in first["attempts"]] == ["succeeded"]
    parent = first["result"]["rig_id"]
    second = studio.finished(
        studio.submit("fit_activations", subject, captures=[pucker], rig_id=parent)
    )
    rig = studio.get(f"/v1/rigs/{second['result']['rig_id']}")
    assert rig["parent_id"] == parent
    assert rig["expressions"] == ["smile", "pucker"]
    assert rig["summary"] == {"train_mean_mm": 0.4}


def test_artifacts_have_etags_and_ranges(studio: Studio) -> None:
    subject = studio.modelled()
    capture = studio.capture(subject, "smile")
    job = studio.finished(studio.submit("fit_geometry", subject, captures=[capture]))
    path = f"/v1/rigs/{job['result']['rig_id']}/artifacts/rig.glb"
    glb = next(a for a in job["result"]["artifacts"] if a["name"] == "rig.glb")
    whole = studio.http.get(path)
    assert whole.headers["etag"] == f'"{glb["sha256"]}"'
    assert whole.headers["content-type"] == "model/gltf-binary"
    part = studio.http.get(path, headers={"Range": "bytes=4-9"})
    assert (part.status_code, part.content) == (206, whole.content[4:10])
    again = studio.http.get(path, headers={"If-None-Match": whole.headers["etag"]})
    assert again.status_code == 304
    refused = studio.http.get(path, headers={"Range": "bytes=9999999-"})
    assert (refused.status_code, refused.json()["code"]) == (416, "artifact.range")
    assert refused.headers["content-range"] == f"bytes */{glb['size']}"
    for wanted, start, end in (("bytes=-5", -5, None), ("bytes=4000-99999", 4000, None)):
        part = studio.http.get(path, headers={"Range": wanted})
        assert (part.status_code, part.content) == (206, whole.content[start:end])
    for given in ({"Range": "lines=1-2"}, {"Range": "bytes=4-9", "If-Range": '"another"'}):
        assert studio.http.get(path, headers=given).content == whole.content
    asked = studio.http.head(path)
    assert (asked.content, asked.headers["content-length"]) == (b"", str(glb["size"]))


def test_a_rigs_page_is_shown_but_may_do_nothing(studio: Studio) -> None:
    _, rig = studio.rigged()
    page = studio.http.get(f"/v1/rigs/{rig}/artifacts/report.html")
    assert "<h1>Report</h1>" in page.text
    assert page.headers["content-type"].startswith("text/html")
    assert page.headers["content-disposition"].startswith("inline")
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "sandbox" in policy
    glb = studio.http.get(f"/v1/rigs/{rig}/artifacts/rig.glb")
    assert glb.headers["content-disposition"].startswith("attachment")


def test_events_tell_the_story_and_resume(studio: Studio) -> None:
    job = studio.submit("build_model", studio.subject(seconds=1))
    story = studio.events(job)
    states = [data["state"] for _, kind, data in story if kind == "state"]
    assert states == ["queued", "running", "succeeded"]
    progress = [data for _, kind, data in story if kind == "progress"]
    assert progress
    assert all(step["phase"] == "geometry" and step["attempt"] == 1 for step in progress)
    assert studio.events(job, after=story[-2][0]) == story[-1:]
    assert studio.events(job, after=story[-1][0]) == []
    log = studio.get(f"/v1/jobs/{job}/log?after=2")
    assert [line["number"] for line in log["lines"]] == list(range(3, log["next"] + 1))
    assert "step 9 of neutral of Alex.obj" in [line["text"] for line in log["lines"]]


@pytest.mark.parametrize(
    ("fault", "expected"),
    [
        (
            "nan",
            {
                "code": "scan.nan",
                "message": "neutral of Alex.obj has a NaN in line 3",
                "file": "neutral of Alex.obj",
                "line": 3,
            },
        ),
        ("crash", {"code": "solver.crash"}),
        ("memory", {"code": "solver.memory"}),
    ],
)
def test_a_fault_fails_the_job_and_the_worker_lives_on(
    studio: Studio, fault: str, expected: dict[str, object]
) -> None:
    job = studio.finished(studio.submit("build_model", studio.subject(fault=fault)))
    assert (job["state"], job["attempt"]) == ("failed", 1)
    assert job["error"].items() >= expected.items()
    log = studio.get(f"/v1/jobs/{job['id']}/log")["lines"]
    assert any("Traceback" in line["text"] for line in log)
    studio.modelled()


@pytest.mark.parametrize("fault", ["none", "deaf"])
def test_cancel_stops_the_solver_within_five_seconds(
    stack_and_studio: tuple[Stack, Studio], fault: str
) -> None:
    stack, studio = stack_and_studio
    seconds = 0.1 if fault == "deaf" else 60
    job = studio.submit("build_model", studio.subject(seconds=seconds, fault=fault))
    studio.until_working(job)
    asked = time.monotonic()
    studio.post(f"/v1/jobs/{job}/cancel", reason="the talent blinked", by="operator")
    done = studio.until(job, "canceled", seconds=5)
    assert time.monotonic() - asked < 5
    assert not studio.solvers(stack)
    assert done["cancel"]["reason"] == "the talent blinked"
    assert [a["outcome"] for a in done["attempts"]] == ["canceled"]
    eventually(lambda: not list(stack.settings.work.glob(f"{job}.*")))


@pytest.mark.slow
def test_a_stopped_stack_gives_its_jobs_back(tmp_path: Path) -> None:
    with running(tmp_path) as (_, studio):
        job = studio.submit("build_model", studio.subject(seconds=1.5))
        studio.until_working(job)
    with running(tmp_path) as (_, studio):
        done = studio.finished(job)
    assert done["state"] == "succeeded"
    assert [a["outcome"] for a in done["attempts"]] == ["released", "succeeded"]
