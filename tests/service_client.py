"""A studio in a test: a running stack with stand-in jobs, and short words to drive it."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import httpx
from fastapi.testclient import TestClient

from myoface.stack import Stack
from service.app import create_app
from service.queue import table
from service.settings import Settings
from service.store.models import DEFAULT_TENANT, Artifact, Rig
from tests.stores import lay_tables

ROOT = Path(__file__).parents[1]
OFFSET_STREAM = "application/offset+octet-stream"
QUICK = {
    "lease": 3.0,
    "beat": 0.2,
    "sweep": 0.5,
    "resend_after": 1.0,
    "port": 0,
    "webhook_workers": 0,
    "ingest_standby": False,
    "live_workers": 0,
    "live_standby": 0,
}
STANDIN = {"jobs": "tests.standin.jobs"}
FINAL = {"succeeded", "failed", "canceled"}


class Studio:
    """The API, spoken directly."""

    def __init__(self, http: httpx.Client, key: str) -> None:
        self.http = http
        self.key = key
        http.headers["Authorization"] = f"Bearer {key}"

    def post(self, path: str, **body: Any) -> Any:
        answer = self.http.post(path, json=body)
        assert answer.is_success, answer.text
        return answer.json()

    def get(self, path: str) -> Any:
        answer = self.http.get(path)
        assert answer.is_success, answer.text
        return answer.json()

    def start_upload(self, name: str, size: int, sha256: str | None = None) -> str:
        metadata = f"filename {_encode(name)}" + (f",sha256 {_encode(sha256)}" if sha256 else "")
        headers = {"Upload-Length": str(size), "Upload-Metadata": metadata}
        answer = self.http.post("/v1/uploads", headers=headers)
        assert answer.status_code == 201, answer.text
        return answer.headers["Location"]

    def send(self, location: str, offset: int, content: bytes, **headers: str) -> httpx.Response:
        headers |= {"Upload-Offset": str(offset), "Content-Type": OFFSET_STREAM}
        return self.http.patch(location, content=content, headers=headers)

    def upload(self, name: str, content: bytes) -> str:
        location = self.start_upload(name, len(content), hashlib.sha256(content).hexdigest())
        assert self.send(location, 0, content).status_code == 204
        return location.rsplit("/", 1)[1]

    def capture(self, subject_id: str, name: str, role: str = "expression", **orders: Any) -> str:
        return self._add(subject_id, name, role, orders, registered=True)

    def raw(self, subject_id: str, name: str, role: str = "expression", **orders: Any) -> str:
        return self._add(subject_id, name, role, orders)

    def performance(self, subject_id: str, name: str, **orders: Any) -> str:
        return self._add(subject_id, name, "performance", orders)

    def _add(
        self, subject_id: str, name: str, role: str, orders: dict[str, Any], **more: Any
    ) -> str:
        lines = [f"# {name}", *(f"#! {key} {value}" for key, value in orders.items())]
        others = {"performance": "npy", "markers": "trc", "activations": "csv", "photo": "jpg"}
        others["film"] = "mp4"
        suffix = others.get(role, "obj")
        upload_id = self.upload(f"{name} of Alex.{suffix}", "\n".join(lines).encode())
        path = f"/v1/subjects/{subject_id}/captures"
        added = self.post(path, name=name, role=role, upload_id=upload_id, **more)
        return str(added["id"])

    def subject(self, **orders: Any) -> str:
        subject_id: str = self.post("/v1/subjects", name="Alex")["id"]
        self.capture(subject_id, "neutral", "neutral", **orders)
        return subject_id

    def modelled(self) -> str:
        """Return a subject whose model is built."""
        subject_id = self.subject()
        self.done("build_model", subject_id)
        return subject_id

    def rigged(self) -> tuple[str, str]:
        """Return a subject and its rig."""
        subject_id = self.modelled()
        smile = self.capture(subject_id, "smile")
        job = self.done("fit_geometry", subject_id, captures=[smile])
        return subject_id, job["result"]["rig_id"]

    def done(self, kind: str, subject_id: str, **more: Any) -> Any:
        """Return a job that was submitted and has succeeded."""
        job = self.finished(self.submit(kind, subject_id, **more))
        assert job["state"] == "succeeded", job
        return job

    def pretend(
        self,
        job_id: str,
        artifacts: dict[str, str],
        summary: dict[str, Any] | None = None,
        rig: dict[str, Any] | None = None,
    ) -> None:
        """Do what a worker does with a job, without one; ``artifacts`` is name -> sha256.

        ``rig`` has the ids of the subject and the model's job, if the job leaves a rig.
        """
        store = self.http.app.state.store.of(DEFAULT_TENANT)  # type: ignore[attr-defined]

        def size(sha256: str) -> int:
            return store.files.size(sha256) if store.files.exists(sha256) else 1

        left = [
            Artifact(job_id=job_id, name=name, size=size(sha256), sha256=sha256, media_type="x")
            for name, sha256 in artifacts.items()
        ]
        with store.write() as session:
            claim = table.take(session, job_id, "test", 10)
            assert claim
            made = rig and Rig(
                **{"expressions": [], "summary": {}, **rig},
                tenant_id=claim.tenant_id,
                job_id=job_id,
            )
            assert table.succeed(session, job_id, claim.attempt, left, summary=summary, rig=made)

    def pretend_rig(self, job_id: str, subject_id: str) -> tuple[Rig, Artifact]:
        """Do what a worker does that leaves a rig with a file, for the tenant whose job it is."""
        store = self.http.app.state.store  # type: ignore[attr-defined]
        with store.write() as session:
            claim = table.take(session, job_id, "test", 10)
            assert claim
            mine = {"tenant_id": claim.tenant_id, "job_id": job_id}
            file = vars(store.files.put(Path(__file__)))
            left = Artifact(name="rig.glb", media_type="model/gltf", **file, **mine)
            rig = Rig(
                subject_id=subject_id, model_job_id=job_id, expressions=[], summary={}, **mine
            )
            assert table.succeed(session, job_id, claim.attempt, [left], rig=rig)
        return rig, left

    def submit(self, kind: str, subject_id: str, **more: Any) -> str:
        return str(self.post("/v1/jobs", kind=kind, subject_id=subject_id, **more)["id"])

    def job(self, job_id: str) -> Any:
        return self.get(f"/v1/jobs/{job_id}")

    def until(self, job_id: str, *states: str, seconds: float = 30) -> Any:
        deadline = time.monotonic() + seconds
        while (job := self.job(job_id))["state"] not in states:
            assert time.monotonic() < deadline, job
            time.sleep(0.05)
        return job

    def finished(self, job_id: str, seconds: float = 30) -> Any:
        return self.until(job_id, *FINAL, seconds=seconds)

    def until_working(self, job_id: str) -> None:
        eventually(lambda: bool(self.job(job_id)["progress"]), seconds=20)

    def events(self, job_id: str, after: int = 0) -> list[tuple[int, str, dict[str, Any]]]:
        headers = {"Last-Event-ID": str(after)}
        text = self.http.get(f"/v1/jobs/{job_id}/events", headers=headers).text
        found = []
        for block in text.strip().split("\n\n"):
            fields = dict(line.split(": ", 1) for line in block.splitlines() if line)
            if "event" in fields:
                found.append((int(fields["id"]), fields["event"], json.loads(fields["data"])))
        return found

    @staticmethod
    def solvers(stack: Stack) -> list[int]:
        """Return the living solver processes of a stack, and what they started."""
        mark = f"MYOFACE_ATTEMPT={stack.settings.work}".encode()
        found = Path("/proc").glob("[0-9]*/environ")
        return [int(path.parent.name) for path in found if mark in _content(path)]


@contextmanager
def served(settings: Settings) -> Iterator[Studio]:
    """Serve the API in this process, without broker and workers: jobs stay queued."""
    lay_tables(settings)
    with TestClient(create_app(settings), base_url="http://127.0.0.1") as http:
        yield Studio(http, settings.admin_key.read_text())


@contextmanager
def running(data_dir: Path, **settings: Any) -> Iterator[tuple[Stack, Studio]]:
    """Run a stack whose solver processes do the stand-in jobs."""
    with mock.patch.dict(os.environ, PYTHONPATH=str(ROOT)):
        stack = Stack(Settings(data_dir=data_dir, **{**QUICK, **STANDIN, **settings}))
    with stack, httpx.Client(base_url=stack.url, timeout=30) as http:
        yield stack, Studio(http, stack.key)


def eventually(condition: Callable[[], bool], seconds: float = 10) -> None:
    """Wait until ``condition`` holds, or fail."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _encode(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
