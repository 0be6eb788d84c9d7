"""A session's scans in one call: checked, registered, modelled and fitted without another."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import insert

from myoface.stack import Stack
from service.settings import Settings
from service.store.models import DEFAULT_TENANT, Batch
from tests.service_client import Studio, eventually, served


@pytest.fixture(scope="module")
def working(stack_and_studio: tuple[Stack, Studio]) -> Studio:
    return stack_and_studio[1]


@pytest.fixture
def idle(tmp_path: Path) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path)) as studio:
        yield studio


def _scan(studio: Studio, name: str, role: str = "expression", **orders: Any) -> dict[str, Any]:
    lines = [f"# {name}", *(f"#! {key} {value}" for key, value in orders.items())]
    upload = studio.upload(f"{name}.obj", "\n".join(lines).encode())
    return {"name": name, "role": role, "upload_id": upload, "registered": False}


def _ended(studio: Studio, batch: dict[str, Any]) -> dict[str, Any]:
    path = f"/v1/batches/{batch['id']}"
    eventually(lambda: studio.get(path)["state"] != "running", seconds=60)
    ended: dict[str, Any] = studio.get(path)
    return ended


def test_scans_become_a_rig_in_one_call(working: Studio) -> None:
    scans = [
        _scan(working, "smile"),
        _scan(working, "neutral", "neutral"),
        _scan(working, "blurred", verdict="bad"),
        _scan(working, "broken", fault="nan"),
    ]
    options = {"build_model": {"edge_mm": 7.0}}
    batch = working.post(
        "/v1/batches", subject={"name": "Alex"}, captures=scans, options=options, priority=2
    )
    assert batch["state"] == "running"
    assert [scan["name"] for scan in batch["scans"]] == ["smile", "neutral", "blurred", "broken"]
    ended = _ended(working, batch)
    assert (ended["state"], ended["error"]) == ("succeeded", None), ended
    of = {scan["name"]: scan for scan in ended["scans"]}
    assert {name: scan["check"]["verdict"] for name, scan in of.items()} == {
        "smile": "good",
        "neutral": "good",
        "blurred": "bad",
        "broken": None,
    }
    assert of["smile"]["registration"]["state"] == of["neutral"]["registration"]["state"]
    assert of["blurred"]["left_out"] == (
        "blurred.obj has no mouth. turn the head towards the lower camera and scan again"
    )
    assert "NaN in line 3" in of["broken"]["left_out"]
    rig = working.get(f"/v1/rigs/{ended['fit']['rig_id']}")
    assert rig["expressions"] == ["smile"]
    model = working.job(ended["model"]["job_id"])
    assert (model["options"], model["priority"]) == ({"edge_mm": 7.0}, 2)
    jobs = working.get(f"/v1/jobs?batch_id={batch['id']}")["items"]
    assert sorted(job["kind"] for job in jobs) == [
        "build_model",
        *["check_scan"] * 4,
        "fit_geometry",
        *["register_scan"] * 2,
    ]


def test_no_batch_goes_on_without_its_neutral(working: Studio) -> None:
    scans = [_scan(working, "neutral", "neutral", verdict="bad"), _scan(working, "smile")]
    ended = _ended(working, working.post("/v1/batches", subject={"name": "x"}, captures=scans))
    assert (ended["state"], ended["error"]["code"]) == ("failed", "batch.neutral")
    assert (ended["model"], ended["fit"]) == (None, None)


def test_a_batch_may_stop_at_the_verdicts(working: Studio) -> None:
    scans = [_scan(working, "neutral", "neutral"), _scan(working, "smile")]
    batch = working.post("/v1/batches", subject={"name": "x"}, captures=scans, then=[])
    ended = _ended(working, batch)
    assert [scan["check"]["verdict"] for scan in ended["scans"]] == ["good", "good"]
    more = [_scan(working, "frown")]
    later = working.post("/v1/batches", subject_id=batch["subject_id"], captures=more, then=[])
    assert _ended(working, later)["state"] == "succeeded"
    found = working.get(f"/v1/batches?subject_id={batch['subject_id']}&state=succeeded")["items"]
    assert [each["id"] for each in found] == [later["id"], batch["id"]]


def test_a_batch_is_all_or_nothing_and_can_be_stopped(idle: Studio) -> None:
    neutral = _scan(idle, "neutral", "neutral")
    smile = _scan(idle, "smile")
    again = _scan(idle, "smile")
    alex = {"subject": {"name": "Alex"}}
    registered = {**smile, "registered": True}
    cases: list[tuple[dict[str, Any], str]] = [
        ({**alex, "captures": [neutral, smile, again]}, "capture.name_taken"),
        ({**alex, "captures": [smile]}, "batch.steps"),
        ({**alex, "captures": [neutral, smile], "then": ["model"]}, "batch.steps"),
        ({**alex, "captures": [neutral], "then": ["register", "geometry"]}, "batch.steps"),
        ({**alex, "captures": [neutral], "options": {"build_model": {"x": 1}}}, "job.options"),
        ({"captures": [neutral]}, "request.invalid"),
        ({**alex, "captures": []}, "request.invalid"),
    ]
    told = []
    for body, code in cases:
        answer = idle.http.post("/v1/batches", json=body)
        assert answer.json()["code"] == code, answer.text
        told.append(answer.json()["detail"])
    assert told[4].startswith("options.build_model.x: build_model has no such option")
    assert told[5] == "give either subject_id or subject"
    for path in ("/v1/subjects", "/v1/jobs", "/v1/batches"):
        assert idle.get(path)["items"] == []
    body = {**alex, "captures": [{**neutral, "registered": True}, registered], "then": ["model"]}
    key = {"Idempotency-Key": "session-7"}
    answers = [idle.http.post("/v1/batches", json=body, headers=key).json() for _ in range(2)]
    batch = answers[0]
    assert answers[1]["id"] == batch["id"]
    for _ in range(2):
        stopped = idle.post(f"/v1/batches/{batch['id']}/cancel", reason="lunch")
        assert (stopped["state"], stopped["cancel"]["reason"]) == ("canceled", "lunch")
    assert {job["state"] for job in idle.get("/v1/jobs")["items"]} == {"canceled"}
    assert idle.http.delete(f"/v1/subjects/{batch['subject_id']}").status_code == 204
    assert idle.get("/v1/batches")["items"] == []


def test_the_longest_page_of_large_batches_is_shown(idle: Studio) -> None:
    subject = idle.subject()
    smile = idle.raw(subject, "smile")
    mine = {"tenant_id": DEFAULT_TENANT, "subject_id": subject, "state": "succeeded"}
    rest = {"name": "x", "steps": [], "options": {}, "priority": 0}
    rows = [
        {**mine, **rest, "capture_ids": [*(str(uuid.uuid4()) for _ in range(70)), smile]}
        for _ in range(1000)
    ]
    with idle.http.app.state.store.write() as session:  # type: ignore[attr-defined]
        session.execute(insert(Batch), rows)
    items = idle.get("/v1/batches?limit=1000")["items"]
    assert len(items) == 1000
    assert all([scan["capture_id"] for scan in item["scans"]] == [smile] for item in items)
