"""Tenants: to each, what belongs to another looks exactly like what does not exist."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.access.principal import Scope
from service.jobs.schemas import NewJob
from service.queue import table
from service.queue.wakeups import LIVE
from service.settings import Settings
from service.store.models import Job, Rig, Tenant
from tests.service_client import OFFSET_STREAM, Studio, served

HTTP = ("get", "head", "post", "put", "patch", "delete")


@pytest.fixture
def tenants(tmp_path: Path) -> Iterator[tuple[Studio, Studio]]:
    with served(Settings(data_dir=tmp_path)) as ours, served(Settings(data_dir=tmp_path)) as theirs:
        state = theirs.http.app.state  # type: ignore[attr-defined]
        with state.store.write() as session:
            session.add(other := Tenant(name="another studio"))
            session.flush()
            _, key = state.keyring.mint(session, other.id, "all", Scope)
        yield ours, Studio(theirs.http, key)


def _one_of_everything(studio: Studio) -> dict[str, str]:
    subject = studio.subject()
    capture = studio.capture(subject, "smile")
    batch_upload = studio.upload("pucker.obj", b"v 0 0 0\n")
    scan = {"name": "pucker", "role": "expression", "upload_id": batch_upload}
    batch = studio.post("/v1/batches", subject_id=subject, captures=[scan], then=[])
    template_upload = studio.upload("anatomy.npz", b"PK")
    template = studio.post("/v1/templates", name="mine", upload_id=template_upload)["id"]
    upload = studio.upload("frown.obj", b"v 0 0 0\n")
    gone = studio.post("/v1/subjects", name="gone")["id"]
    receipt = studio.http.delete(f"/v1/subjects/{gone}").headers["Location"]
    job = studio.submit("build_model", subject)
    rig, left = studio.pretend_rig(job, subject)
    webhook = studio.post("/v1/webhooks", url="https://8.8.8.8/")["id"]
    delivery = studio.post(f"/v1/webhooks/{webhook}/test")["id"]
    return {
        "subject_id": subject,
        "capture_id": capture,
        "template_id": template,
        "upload_id": upload,
        "job_id": job,
        "rig_id": rig.id,
        "session_id": _session(studio, rig),
        "batch_id": batch["id"],
        "artifact_id": left.id,
        "key_id": studio.post("/v1/keys", name="x", scopes=["read"])["id"],
        "deletion_id": receipt.rsplit("/", 1)[1],
        "webhook_id": webhook,
        "delivery_id": delivery,
        "name": "rig.glb",
    }


def _session(studio: Studio, rig: Rig) -> str:
    """Return a live session of a tenant's, as it is queued."""
    store = studio.http.app.state.store.of(rig.tenant_id)  # type: ignore[attr-defined]
    order = NewJob(kind="live_session", subject_id=rig.subject_id, rig_id=rig.id)
    with store.write() as session:
        job = Job(
            tenant_id=rig.tenant_id,
            subject_id=rig.subject_id,
            kind=order.kind,
            queue=LIVE,
            request=order.model_dump(),
            inputs=[],
            max_attempts=1,
        )
        table.create(session, job)
        return str(job.id)


BODIES: dict[tuple[str, str], dict[str, Any]] = {
    ("post", "/v1/subjects/{subject_id}/captures"): {"json": {"name": "x", "role": "expression"}},
    ("put", "/v1/subjects/{subject_id}/captures/{capture_id}/landmarks"): {"json": {}},
    **{
        ("patch", path): {"headers": {"Content-Type": "application/json"}, "content": b"{}"}
        for path in (
            "/v1/subjects/{subject_id}",
            "/v1/subjects/{subject_id}/captures/{capture_id}",
            "/v1/rigs/{rig_id}",
            "/v1/webhooks/{webhook_id}",
        )
    },
    ("put", "/v1/live/{session_id}/recording"): {
        "headers": {"Content-Type": "application/json"},
        "content": b'{"name": "x"}',
    },
    ("patch", "/v1/uploads/{upload_id}"): {
        "headers": {"Upload-Offset": "0", "Content-Type": OFFSET_STREAM},
        "content": b"v",
    },
}
"""What the operations on a foreign id are sent; an upload's id is added."""
CHOSEN_BY_THE_CALLER = {("put", "/v1/jobs/{job_id}")}


def test_foreign_ids_answer_as_unknown_ones_on_every_verb(tenants: tuple[Studio, Studio]) -> None:
    ours, theirs = tenants
    foreign = _one_of_everything(ours)
    unknown = {name: str(uuid.uuid4()) for name in foreign}
    unknown |= {"name": "rig.glb", "key_id": "0" * 12}
    tried = 0
    for path, operations in ours.get("/openapi.json")["paths"].items():
        if "{" not in path:
            continue
        for method in set(operations) & set(HTTP):
            if (method, path) in CHOSEN_BY_THE_CALLER:
                continue
            answers = [_ask(theirs, method, path, ids) for ids in (foreign, unknown)]
            assert [each[0] for each in answers] == [404, 404], (method, path, answers)
            assert answers[0] == answers[1], (method, path)
            tried += 1
    assert tried >= 15
    lists = ("jobs", "live", "rigs", "subjects", "templates", "batches")
    for path in (f"/v1/{each}" for each in lists):
        assert theirs.get(path)["items"] == []
        assert ours.get(path)["items"] != []
    for path in ("/v1/jobs", "/v1/rigs"):
        assert theirs.get(f"{path}?subject_id={foreign['subject_id']}")["items"] == []


def _ask(studio: Studio, method: str, path: str, ids: dict[str, str]) -> tuple[int, str]:
    """Return the answer's status and its problem, less what every answer has of its own."""
    request = {
        key: dict(value) if isinstance(value, dict) else value
        for key, value in BODIES.get((method, path), {}).items()
    }
    if "json" in request:
        request["json"] |= {"upload_id": ids["upload_id"]}
    answer = studio.http.request(method.upper(), path.format(**ids), **request)
    text = answer.text.replace(answer.headers["X-Request-Id"], "")
    for name, identifier in ids.items():
        text = text.replace(identifier, name)
    return answer.status_code, text


def test_foreign_ids_in_bodies_are_unknown(tenants: tuple[Studio, Studio]) -> None:
    ours, theirs = tenants
    foreign = _one_of_everything(ours)
    mine = _one_of_everything(theirs)
    captures = f"/v1/subjects/{mine['subject_id']}/captures"
    fit = {"kind": "fit_activations", "subject_id": mine["subject_id"]}
    scan = {"name": "x", "role": "expression", "upload_id": foreign["upload_id"]}
    cases: list[tuple[str, dict[str, Any], str]] = [
        ("/v1/subjects", {"name": "x", "template_id": foreign["template_id"]}, "template"),
        ("/v1/templates", {"name": "x", "upload_id": foreign["upload_id"]}, "upload"),
        (
            captures,
            {"name": "x", "role": "expression", "upload_id": foreign["upload_id"]},
            "upload",
        ),
        ("/v1/jobs", {"kind": "build_model", "subject_id": foreign["subject_id"]}, "subject"),
        ("/v1/live", {"rig_id": foreign["rig_id"]}, "rig"),
        ("/v1/batches", {"subject_id": foreign["subject_id"], "captures": [scan]}, "subject"),
        ("/v1/batches", {"subject": {"name": "x"}, "captures": [scan]}, "upload"),
        ("/v1/jobs", {**fit, "rig_id": foreign["rig_id"], "captures": [mine["capture_id"]]}, "rig"),
        (
            "/v1/jobs",
            {
                "kind": "check_scan",
                "subject_id": mine["subject_id"],
                "captures": [foreign["capture_id"]],
            },
            "capture",
        ),
    ]
    for path, body, what in cases:
        answer = theirs.http.post(path, json=body)
        assert (answer.status_code, answer.json()["code"]) == (404, f"{what}.unknown"), body
    taken = {"kind": "build_model", "subject_id": mine["subject_id"]}
    answer = theirs.http.put(f"/v1/jobs/{foreign['job_id']}", json=taken)
    assert answer.status_code == 409, answer.text
    assert ours.job(foreign["job_id"])["subject_id"] == foreign["subject_id"]


def test_deleting_a_subject_leaves_another_tenants_upload_of_the_same_file(
    tenants: tuple[Studio, Studio],
) -> None:
    ours, theirs = tenants
    kept = theirs.upload("same.obj", b"v 1 2 3\n")
    subject = ours.post("/v1/subjects", name="Alex")["id"]
    upload = ours.upload("same.obj", b"v 1 2 3\n")
    ours.post(f"/v1/subjects/{subject}/captures", name="neutral", role="neutral", upload_id=upload)
    assert ours.http.delete(f"/v1/subjects/{subject}").status_code == 204
    assert ours.http.get(f"/v1/uploads/{upload}").status_code == 404
    assert theirs.get(f"/v1/uploads/{kept}")["state"] == "complete"
