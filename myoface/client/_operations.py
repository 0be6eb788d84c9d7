"""What a client can ask of the service, each as a flow (`myoface.connection`)."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable
from datetime import datetime
from pathlib import Path
from typing import Any, TypeVar

import httpx

from myoface import transfer
from myoface.client._events import EventReader
from myoface.connection import (
    LONGEST_WISH_S,
    Flow,
    Open,
    Patience,
    Pause,
    Read,
    checked,
    once,
    patiently,
    wished,
)
from myoface.errors import ApiError
from myoface.resources import (
    FINAL_STATES,
    Artifact,
    AuditEntry,
    Batch,
    Capture,
    Deletion,
    Frame,
    Job,
    JobKind,
    Key,
    Kind,
    LogLine,
    Me,
    MotionFrame,
    NewKey,
    Progress,
    Resource,
    Rig,
    Role,
    Scope,
    Subject,
    Template,
    Then,
    Upload,
    Usage,
)
from myoface.transfer import Transferred, unheard

DEFAULT_URL = "http://127.0.0.1:8765"
LONGEST_PAGE = 1000
"""The service lists at most so many things at a time."""
FRAMES_A_PAGE = 100
FRAMES_PAUSE = 0.5
BATCH_PAUSE = 1.0
TOO_MANY_STREAMS = "stream.too_many"
STREAM_PAUSE = 2.0

# The service sends a comment line at least this often while a job has nothing to tell.
EVENTS_TIMEOUT = httpx.Timeout(30.0, read=60.0)

R = TypeVar("R", bound=Resource)
Watcher = Callable[[Job], None]
"""Called with the job whenever its state or progress has changed."""
BatchWatcher = Callable[[Batch], None]
"""Called with the batch about once a second."""


def unwatched(_job: Job, /) -> None:
    """Let a job run without looking."""


def unwatched_batch(_batch: Batch, /) -> None:
    """Let a batch run without looking."""


class Operations:
    """The calls of the service at ``url``."""

    def __init__(self, url: str) -> None:
        self._url = url

    # Whose key, and what it may use

    def me(self) -> Flow[Me]:
        return self._get("/v1/me", Me)

    def usage(self) -> Flow[Usage]:
        return self._get("/v1/usage", Usage)

    def keys(self) -> Flow[list[Key]]:
        return self._list("/v1/keys", Key)

    def create_key(
        self, name: str, scopes: Iterable[Scope], expires_at: datetime | None
    ) -> Flow[NewKey]:
        until = expires_at and expires_at.isoformat()
        return self._make("/v1/keys", NewKey, name=name, scopes=list(scopes), expires_at=until)

    def rotate_key(self, key_id: str, grace: int) -> Flow[NewKey]:
        return self._make(f"/v1/keys/{key_id}/rotate", NewKey, grace=grace)

    def revoke_key(self, key_id: str) -> Flow[None]:
        yield from patiently("DELETE", f"/v1/keys/{key_id}")

    def audit(self, object_id: str | None) -> Flow[list[AuditEntry]]:
        return self._list("/v1/audit", AuditEntry, object_id=object_id)

    # Templates and subjects

    def create_template(self, name: str, path: Path, progress: Transferred) -> Flow[Template]:
        sent = yield from self.upload(path, progress)
        return (yield from self._make("/v1/templates", Template, name=name, upload_id=sent.id))

    def templates(self) -> Flow[list[Template]]:
        return self._list("/v1/templates", Template)

    def delete_template(self, template_id: str) -> Flow[str]:
        return self._delete(f"/v1/templates/{template_id}")

    def create_subject(self, name: str, template_id: str | None) -> Flow[Subject]:
        return self._make("/v1/subjects", Subject, name=name, template_id=template_id)

    def subjects(self) -> Flow[list[Subject]]:
        return self._list("/v1/subjects", Subject)

    def subject(self, subject_id: str) -> Flow[Subject]:
        return self._get(f"/v1/subjects/{subject_id}", Subject)

    def delete_subject(self, subject_id: str, cancel: bool) -> Flow[str]:
        return self._delete(f"/v1/subjects/{subject_id}", cancel=str(cancel).lower())

    def deletion(self, deletion_id: str) -> Flow[Deletion]:
        return self._get(f"/v1/deletions/{deletion_id}", Deletion)

    # Files

    def upload(self, path: Path, progress: Transferred = unheard) -> Flow[Upload]:
        return transfer.upload(self._url, path, progress=progress)

    def download(self, artifact: Artifact, path: Path, progress: Transferred) -> Flow[None]:
        return transfer.download(artifact, path, progress=progress)

    def signed_url(self, artifact_id: str) -> Flow[str]:
        response = yield from patiently("POST", f"/v1/artifacts/{artifact_id}/url")
        return str(httpx.URL(self._url).join(response.json()["url"]))

    def add_capture(
        self,
        subject_id: str,
        path: Path,
        *,
        role: Role,
        name: str | None,
        registered: bool,
        landmarks: Path | None,
        progress: Transferred,
    ) -> Flow[Capture]:
        marks = None if landmarks is None else (yield from self.upload(landmarks)).id
        sent = yield from self.upload(path, progress)
        return (
            yield from self._make(
                f"/v1/subjects/{subject_id}/captures",
                Capture,
                name=name or path.stem,
                role=role,
                upload_id=sent.id,
                registered=registered,
                landmarks_upload_id=marks,
            )
        )

    def captures(self, subject_id: str) -> Flow[list[Capture]]:
        return self._list(f"/v1/subjects/{subject_id}/captures", Capture)

    def capture(self, subject_id: str, capture_id: str) -> Flow[Capture]:
        return self._get(f"/v1/subjects/{subject_id}/captures/{capture_id}", Capture)

    def set_landmarks(self, subject_id: str, capture_id: str, path: Path) -> Flow[Capture]:
        url = f"/v1/subjects/{subject_id}/captures/{capture_id}/landmarks"
        sent = yield from self.upload(path)
        response = yield from patiently("PUT", url, json={"upload_id": sent.id})
        return Capture.model_validate(response.json())

    def delete_capture(self, subject_id: str, capture_id: str) -> Flow[str]:
        return self._delete(f"/v1/subjects/{subject_id}/captures/{capture_id}")

    # Jobs

    def solvers(self) -> Flow[list[JobKind]]:
        return self._list("/v1/solvers", JobKind)

    def submit(
        self,
        kind: Kind,
        subject_id: str,
        captures: Iterable[str],
        rig_id: str | None,
        options: dict[str, Any] | None,
        priority: int,
    ) -> Flow[Job]:
        body = {
            "kind": kind,
            "subject_id": subject_id,
            "captures": list(captures),
            "rig_id": rig_id,
            "options": options,
            "priority": priority,
        }
        body = {key: value for key, value in body.items() if value}
        response = yield from patiently("PUT", f"/v1/jobs/{uuid.uuid4()}", json=body)
        return Job.model_validate(response.json())

    def retry(
        self,
        job_id: str,
        captures: Iterable[str] | None,
        options: dict[str, Any] | None,
        priority: int | None,
    ) -> Flow[Job]:
        body = {
            "captures": None if captures is None else list(captures),
            "options": options,
            "priority": priority,
        }
        return self._make(f"/v1/jobs/{job_id}/retry", Job, **body)

    def job(self, job_id: str) -> Flow[Job]:
        return self._get(f"/v1/jobs/{job_id}", Job)

    def jobs(self, **filters: str | None) -> Flow[list[Job]]:
        return self._list("/v1/jobs", Job, **filters)

    def log(self, job_id: str, after: int) -> Flow[list[LogLine]]:
        response = yield from patiently("GET", f"/v1/jobs/{job_id}/log", params={"after": after})
        return list(map(LogLine.model_validate, response.json()["lines"]))

    def frames(self, job_id: str, start: int, follow: bool) -> Flow[list[Frame | MotionFrame]]:
        """Return a page of frames; with ``follow``, wait for it unless the job has ended."""
        url = f"/v1/jobs/{job_id}"
        query = {"start": start, "limit": FRAMES_A_PAGE}
        while True:
            job = yield from patiently("GET", url, through=True)
            page = yield from patiently("GET", f"{url}/frames", through=True, params=query)
            found = list(map(_frame, page.json()["frames"]))
            if found or not follow or job.json()["state"] in FINAL_STATES:
                return found
            yield Pause(FRAMES_PAUSE)

    def cancel(self, job_id: str, reason: str) -> Flow[Job]:
        response = yield from once("POST", f"/v1/jobs/{job_id}/cancel", json={"reason": reason})
        return Job.model_validate(response.json())

    def wait(self, job_id: str, watch: Watcher) -> Flow[Job]:
        patience = Patience()
        while True:
            response = yield from patiently("GET", f"/v1/jobs/{job_id}", through=True)
            job = Job.model_validate(response.json())
            watch(job)
            if job.state in FINAL_STATES:
                return _succeeded(job)
            try:
                yield from _follow(job, watch, patience)
            except ApiError as error:
                if error.code == TOO_MANY_STREAMS:
                    # asking again and again does as well
                    yield Pause(min(wished(error) or STREAM_PAUSE, LONGEST_WISH_S))
                else:
                    yield from patience.bear(error)

    # Batches

    def create_batch(
        self,
        neutral: Path | None,
        expressions: Iterable[Path],
        *,
        subject_id: str | None,
        person: str | None,
        registered: bool,
        then: Iterable[Then],
        options: dict[str, dict[str, Any]] | None,
        priority: int,
        progress: Transferred,
    ) -> Flow[Batch]:
        files: list[tuple[Path, Role]] = [] if neutral is None else [(neutral, "neutral")]
        files += [(path, "expression") for path in expressions]
        captures = []
        for path, role in files:
            sent = yield from self.upload(path, progress)
            captures.append(
                {"name": path.stem, "role": role, "upload_id": sent.id, "registered": registered}
            )
        return (
            yield from self._make(
                "/v1/batches",
                Batch,
                subject_id=subject_id,
                subject=None if person is None else {"name": person},
                captures=captures,
                then=list(then),
                options=options,
                priority=priority,
            )
        )

    def batches(self, subject_id: str | None) -> Flow[list[Batch]]:
        return self._list("/v1/batches", Batch, subject_id=subject_id)

    def batch(self, batch_id: str) -> Flow[Batch]:
        return self._get(f"/v1/batches/{batch_id}", Batch)

    def cancel_batch(self, batch_id: str, reason: str) -> Flow[Batch]:
        url = f"/v1/batches/{batch_id}/cancel"
        response = yield from once("POST", url, json={"reason": reason})
        return Batch.model_validate(response.json())

    def wait_for_batch(self, batch_id: str, watch: BatchWatcher) -> Flow[Batch]:
        while True:
            response = yield from patiently("GET", f"/v1/batches/{batch_id}", through=True)
            batch = Batch.model_validate(response.json())
            watch(batch)
            if batch.state != "running":
                return _finished(batch)
            yield Pause(BATCH_PAUSE)

    # Rigs

    def rigs(self, subject_id: str | None) -> Flow[list[Rig]]:
        return self._list("/v1/rigs", Rig, subject_id=subject_id)

    def rig(self, rig_id: str) -> Flow[Rig]:
        return self._get(f"/v1/rigs/{rig_id}", Rig)

    # Requests

    def _get(self, url: str, kind: type[R]) -> Flow[R]:
        response = yield from patiently("GET", url)
        return kind.model_validate(response.json())

    def _make(self, url: str, kind: type[R], /, **body: Any) -> Flow[R]:
        """Make something once, however often the line breaks."""
        given = {key: value for key, value in body.items() if value is not None}
        headers = {"Idempotency-Key": str(uuid.uuid4())}
        response = yield from patiently("POST", url, json=given, headers=headers)
        return kind.model_validate(response.json())

    def _delete(self, url: str, **query: Any) -> Flow[str]:
        """Delete something; returns the id of the receipt."""
        response = yield from once("DELETE", url, params=query)
        location: str = response.headers["Location"]
        return location.rsplit("/", 1)[-1]

    def _list(self, url: str, kind: type[R], /, **query: Any) -> Flow[list[R]]:
        given = {key: value for key, value in query.items() if value is not None}
        found: list[R] = []
        while True:
            params = {"limit": LONGEST_PAGE, **given}
            page = (yield from patiently("GET", url, params=params)).json()
            found += map(kind.model_validate, page["items"])
            if page.get("next") is None:
                return found
            given["cursor"] = page["next"]


def _follow(job: Job, watch: Watcher, patience: Patience) -> Flow[None]:
    """Tell ``watch`` a job's progress until its state changes."""
    headers = {"Last-Event-ID": str(job.last_event_id)}
    options = {"headers": headers, "timeout": EVENTS_TIMEOUT}
    checked((yield Open("GET", f"/v1/jobs/{job.id}/events", options)))
    reader = EventReader()
    while (content := (yield Read())) is not None:
        for event in reader.feed(content):
            patience.reset()
            if event.kind != "progress":
                return
            watch(job.model_copy(update={"progress": Progress.model_validate(event.data)}))


def _frame(values: dict[str, Any]) -> Frame | MotionFrame:
    """Return a frame of a sequence, or of a simulation: that one has no status."""
    return (Frame if "status" in values else MotionFrame).model_validate(values)


def _succeeded(job: Job) -> Job:
    if job.state == "succeeded":
        return job
    why = f": {job.cancel.reason}" if job.cancel and job.cancel.reason else ""
    ended = {"code": f"job.{job.state}", "detail": f"{job.kind} job {job.id} was {job.state}{why}"}
    raise ApiError(job.error or ended)


def _finished(batch: Batch) -> Batch:
    if batch.state == "succeeded":
        return batch
    ended = {"code": f"batch.{batch.state}", "detail": f"batch {batch.id} was {batch.state}"}
    raise ApiError(batch.error or ended)
