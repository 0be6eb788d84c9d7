"""From the scanner's own file to a model: check, register, build."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from myoface.stack import Stack
from service.settings import Settings
from service.store.models import Job, Upload
from tests.service_client import Studio, served


@pytest.fixture(scope="module")
def working(stack_and_studio: tuple[Stack, Studio]) -> Studio:
    return stack_and_studio[1]


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    """An API without broker and workers: jobs stay queued."""
    settings = Settings(data_dir=tmp_path)
    with served(settings) as studio:
        yield studio


def test_raw_scans_become_a_model_and_a_rig(working: Studio) -> None:
    subject = working.post("/v1/subjects", name="Alex")["id"]
    neutral = working.raw(subject, "neutral", "neutral")
    smile = working.raw(subject, "smile")
    landmarks = working.upload("marks.json", b"{}")
    path = f"/v1/subjects/{subject}/captures/{neutral}"
    working.http.put(f"{path}/landmarks", json={"upload_id": landmarks}).raise_for_status()

    options = {"unit": "cm", "up": "-z"}
    check = working.done("check_scan", subject, captures=[neutral], options=options)
    assert check["result"]["summary"]["verdict"] == "good"
    assert check["result"]["summary"]["figures"] == {
        "landmarks": "{}",
        "options": {**options, "role": "neutral"},
    }
    assert [each["name"] for each in check["result"]["artifacts"]] == ["check.json", "check.png"]

    registration = working.done("register_scan", subject, captures=[neutral])
    shown = working.get(path)
    assert (shown["registered"], shown["landmarks"]) == (False, "marks.json")
    assert (shown["check"]["job_id"], shown["check"]["verdict"]) == (check["id"], "good")
    assert shown["registration"]["job_id"] == registration["id"]
    mesh = working.http.get(f"/v1/artifacts/{shown['registration']['artifact_id']}")
    assert mesh.content == b"registered # neutral by {}"

    model = working.done("build_model", subject)
    assert content(working, model, "model.npz") == b"model of " + mesh.content
    of_smile = working.done("register_scan", subject, captures=[smile])
    expected = b"registered # smile by " + mesh.content
    assert content(working, of_smile, "registered.ply") == expected
    assert of_smile["result"]["summary"]["neutral"] == "neutral.registered.ply"
    rig = working.done("fit_geometry", subject, captures=[smile])
    assert rig["result"]["summary"] == {"train_mean_mm": 0.4}


def content(studio: Studio, job: Any, name: str) -> bytes:
    artifact = next(each for each in job["result"]["artifacts"] if each["name"] == name)
    answer = studio.http.get(f"/v1/artifacts/{artifact['id']}")
    assert hashlib.sha256(answer.content).hexdigest() == artifact["sha256"]
    return answer.content


def test_a_bad_scan_is_a_verdict_and_no_failure(working: Studio) -> None:
    subject = working.post("/v1/subjects", name="Alex")["id"]
    capture = working.raw(subject, "smile", verdict="bad")
    check = working.done("check_scan", subject, captures=[capture])
    finding = check["result"]["summary"]["findings"][0]
    assert finding["message"] == "smile of Alex.obj has no mouth"
    shown = working.get(f"/v1/subjects/{subject}/captures")["items"]
    assert [each["check"]["verdict"] for each in shown] == ["bad"]
    about = working.get(f"/v1/jobs?capture_id={capture}")["items"]
    assert [each["id"] for each in about] == [check["id"]]


def test_a_long_job_keeps_no_verdict_waiting(working: Studio) -> None:
    subject = working.subject(seconds=20)
    building = working.submit("build_model", subject)
    working.until_working(building)
    working.done("check_scan", subject, captures=[working.raw(subject, "smile")])
    assert working.job(building)["state"] == "running"
    working.post(f"/v1/jobs/{building}/cancel", reason="seen enough")


def test_what_can_not_be_read_yet(studio: Studio) -> None:
    nobody = studio.post("/v1/subjects", name="Nobody")["id"]
    alone = studio.raw(nobody, "smile")
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    neutral = studio.raw(subject, "neutral", "neutral")
    smile = studio.raw(subject, "smile")
    ready = studio.capture(subject, "ready")

    def refusal(kind: str, subject_id: str, *captures: str) -> tuple[int, str, str]:
        body = {"kind": kind, "subject_id": subject_id, "captures": list(captures)}
        answer = studio.http.post("/v1/jobs", json=body)
        problem = answer.json()
        return answer.status_code, problem["code"], problem["detail"]

    raw = "is a raw scan: register it first"
    not_yet = "an expression is registered from the neutral: register neutral first"
    no_neutral = "the subject has no neutral capture"
    assert refusal("register_scan", nobody, alone) == (409, "subject.no_neutral", no_neutral)
    assert refusal("register_scan", subject, smile) == (
        409,
        "subject.neutral_not_registered",
        not_yet,
    )
    assert refusal("build_model", subject) == (409, "capture.not_registered", f"neutral {raw}")
    assert refusal("register_scan", subject, ready)[:2] == (409, "capture.is_registered")
    assert refusal("check_scan", subject)[:2] == (422, "job.one_capture")
    assert refusal("check_scan", subject, neutral, smile)[:2] == (422, "job.one_capture")
    assert refusal("check_scan", subject, alone)[:2] == (404, "capture.unknown")

    register(studio, subject, neutral, "a" * 64)
    build(studio, subject)
    frown = studio.raw(subject, "frown")
    assert refusal("fit_geometry", subject, smile, ready, frown) == (
        409,
        "capture.not_registered",
        f"smile {raw}; frown {raw}",
    )


def register(studio: Studio, subject: str, capture: str, sha256: str) -> None:
    job = studio.submit("register_scan", subject, captures=[capture])
    studio.pretend(job, {"registered.ply": sha256}, {})


def build(studio: Studio, subject: str) -> None:
    studio.pretend(studio.submit("build_model", subject), {"model.npz": "0" * 64}, {})


def test_no_fit_mixes_two_neutrals(studio: Studio) -> None:
    """A fit reads the registrations that were made from the neutral its model was built of."""
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    neutral = studio.raw(subject, "neutral", "neutral")
    smile = studio.raw(subject, "smile")
    first = "a" * 64
    second = "b" * 64
    third = "c" * 64

    def fit() -> tuple[int, Any]:
        body = {"kind": "fit_geometry", "subject_id": subject, "captures": [smile]}
        answer = studio.http.post("/v1/jobs", json=body)
        if answer.is_success:
            return 201, inputs(studio, answer.json()["id"])["capture"]
        return answer.status_code, answer.json()["detail"]

    register(studio, subject, neutral, first)
    register(studio, subject, smile, second)
    build(studio, subject)
    assert fit() == (201, second)

    register(studio, subject, neutral, third)
    assert fit() == (201, second)  # model and smile are still of one neutral
    build(studio, subject)
    again = "smile was registered from an earlier neutral: register it again"
    assert fit() == (409, again)
    register(studio, subject, smile, "d" * 64)
    assert fit() == (201, "d" * 64)

    register(studio, subject, neutral, "e" * 64)
    pucker = smile = studio.raw(subject, "pucker")
    register(studio, subject, pucker, "f" * 64)
    behind = "pucker belongs to a newer neutral than the model's: build the model again"
    assert fit() == (409, behind)


def inputs(studio: Studio, job_id: str) -> dict[str, str]:
    """Return which file a job reads as what."""
    with studio.http.app.state.store.read() as session:  # type: ignore[attr-defined]
        return {item["role"]: item["sha256"] for item in session.get(Job, job_id).inputs}


def test_inputs_are_fixed_when_a_job_is_submitted(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    neutral = studio.raw(subject, "neutral", "neutral")
    register(studio, subject, neutral, "a" * 64)
    path = f"/v1/jobs/{uuid.uuid4()}"
    body = {"kind": "build_model", "subject_id": subject}
    assert studio.http.put(path, json=body).status_code == 201
    register(studio, subject, neutral, "b" * 64)
    again = studio.http.put(path, json=body)
    assert again.status_code == 200
    assert inputs(studio, again.json()["id"])["neutral"] == "a" * 64


def test_what_a_capture_may_be_made_of(studio: Studio) -> None:
    subject = studio.post("/v1/subjects", name="Alex")["id"]
    path = f"/v1/subjects/{subject}/captures"
    cloud = studio.upload("cloud.xyz", b"0 0 0")
    marks = studio.upload("marks.doc", b"0 0 0")
    body = {"name": "smile", "role": "expression", "upload_id": cloud}
    cases = [
        ({**body, "registered": True}, "capture.format"),
        ({**body, "landmarks_upload_id": marks}, "landmarks.format"),
    ]
    for each, code in cases:
        answer = studio.http.post(path, json=each)
        assert (answer.status_code, answer.json()["code"]) == (422, code)
    assert studio.post(path, **body)["registered"] is False


def test_a_deleted_scan_takes_its_checks_and_registrations_along(studio: Studio) -> None:
    subject = studio.subject()
    smile = studio.raw(subject, "smile")
    path = f"/v1/subjects/{subject}/captures/{smile}"
    marks = {"upload_id": studio.upload("smile.json", b"{}")}
    assert studio.http.put(f"{path}/landmarks", json=marks).status_code == 200
    register(studio, subject, smile, "a" * 64)
    job = studio.get(path)["registration"]["job_id"]
    assert studio.http.delete(path).status_code == 204
    assert studio.http.get(f"/v1/jobs/{job}").status_code == 404
    with studio.http.app.state.store.read() as session:  # type: ignore[attr-defined]
        left = [each.filename for each in session.scalars(select(Upload))]
    assert left == ["neutral of Alex.obj"]
