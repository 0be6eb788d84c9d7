"""POSTs that are sent again with their `Idempotency-Key`."""

from __future__ import annotations

import threading
import uuid
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.errors import Problem
from service.jobs import service as jobs
from service.settings import Settings
from tests.service_client import Studio, served

pytestmark = pytest.mark.telling


def _post(studio: Studio, path: str, key: str, **body: Any) -> httpx.Response:
    return studio.http.post(path, json=body, headers={"Idempotency-Key": key})


def test_a_repetition_makes_nothing(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        subject = studio.subject()
        scan = studio.upload("smile.obj", b"v 0 0 0\n")
        anatomy = studio.upload("anatomy.npz", b"PK")
        cases: list[tuple[str, dict[str, Any]]] = [
            ("/v1/subjects", {"name": "Bo"}),
            ("/v1/templates", {"name": "mine", "upload_id": anatomy}),
            (
                f"/v1/subjects/{subject}/captures",
                {"name": "smile", "role": "expression", "upload_id": scan},
            ),
            ("/v1/jobs", {"kind": "build_model", "subject_id": subject}),
            ("/v1/keys", {"name": "x", "scopes": ["read"]}),
        ]
        for number, (path, body) in enumerate(cases):
            first, again = (_post(studio, path, f"k{number}", **body) for _ in range(2))
            assert (first.status_code, again.status_code) == (201, 201), again.text
            assert first.json()["id"] == again.json()["id"]
            told = {**first.json(), "key": None} if path == "/v1/keys" else first.json()
            assert again.json() == told
            other = _post(studio, path, f"k{number}", **{**body, **_changed(body)})
            assert (other.status_code, other.json()["code"]) == (422, "idempotency.conflict")
        assert len(studio.get("/v1/jobs")["items"]) == 1
        entries = studio.get("/v1/audit")["items"]
        made = [each for each in entries if each["action"] == "key.created"]
        assert [each["key_id"] for each in made] == [studio.get("/v1/me")["key_id"], "operator"]


def test_what_is_made_from_something_else_is_made_once_too(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        job = studio.submit("build_model", studio.subject())
        studio.post(f"/v1/jobs/{job}/cancel")
        key = studio.post("/v1/keys", name="renderer", scopes=["read"])["id"]
        hook = studio.post("/v1/webhooks", url="https://8.8.8.8/")
        cases: list[tuple[str, dict[str, Any]]] = [
            (f"/v1/jobs/{job}/retry", {"priority": 1}),
            (f"/v1/keys/{key}/rotate", {"grace": 60}),
            ("/v1/webhooks", {"url": "https://8.8.4.4/"}),
        ]
        for number, (path, body) in enumerate(cases):
            first, again = (_post(studio, path, f"k{number}", **body) for _ in range(2))
            assert (first.status_code, again.status_code) == (201, 201), again.text
            told = {name: None for name in ("key", "secret") if name in first.json()}
            assert again.json() == first.json() | told
        assert len(studio.get("/v1/jobs")["items"]) == 2
        assert len(studio.get("/v1/keys")["items"]) == 3
        path = f"/v1/webhooks/{hook['id']}/rotate"
        first, again = (_post(studio, path, "r") for _ in range(2))
        assert again.json() == first.json() | {"secret": None}
        assert first.json()["secret"] != hook["secret"]
        other = studio.post("/v1/keys", name="other", scopes=["webhooks"])["key"]
        headers = {"Authorization": f"Bearer {other}", "Idempotency-Key": "r"}
        assert studio.http.post(path, headers=headers).json()["secret"] is None


def _changed(body: dict[str, Any]) -> dict[str, Any]:
    return {"options": {"edge_mm": 5}} if "kind" in body else {"name": "another"}


def test_a_request_that_failed_left_nothing(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        subject = studio.post("/v1/subjects", name="Alex")["id"]
        body = {"kind": "build_model", "subject_id": subject}
        assert _post(studio, "/v1/jobs", "k", **body).status_code == 409  # no neutral yet
        studio.capture(subject, "neutral", "neutral")
        assert _post(studio, "/v1/jobs", "k", **body).status_code == 201
        bad = studio.http.post("/v1/subjects", json={"name": "x"}, headers={"Idempotency-Key": " "})
        assert bad.status_code == 422


def test_many_at_a_time_make_one(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        studio.post("/v1/subjects", name="before")
        answers: list[httpx.Response] = []
        ready = threading.Barrier(6)

        def ask() -> None:
            ready.wait()
            answers.append(_post(studio, "/v1/subjects", "storm", name="Ada"))

        threads = [threading.Thread(target=ask) for _ in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert {answer.status_code for answer in answers} <= {201, 409}
        made = {answer.json()["id"] for answer in answers if answer.status_code == 201}
        assert len(made) == 1
        codes = {answer.json()["code"] for answer in answers if answer.status_code == 409}
        assert codes <= {"idempotency.in_flight"}
        names = [each["name"] for each in studio.get("/v1/subjects")["items"]]
        assert names.count("Ada") == 1


def test_a_repetition_is_answered_though_its_options_would_be_refused_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        body = {"kind": "build_model", "subject_id": studio.subject()}
        path = f"/v1/jobs/{uuid.uuid4()}"
        put = studio.http.put(path, json=body)
        posted = _post(studio, "/v1/jobs", "k", **body)
        assert (put.status_code, posted.status_code) == (201, 201)

        def refuse(*_: Any) -> None:
            raise Problem(422, "job.options", "an upgrade has tightened an option")

        monkeypatch.setattr(jobs, "check_options", refuse)
        again = studio.http.put(path, json=body)
        assert (again.status_code, again.json()["id"]) == (200, put.json()["id"])
        again = _post(studio, "/v1/jobs", "k", **body)
        assert (again.status_code, again.json()["id"]) == (201, posted.json()["id"])
        assert _post(studio, "/v1/jobs", "other", **body).status_code == 422
