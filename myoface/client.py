"""The service from Python: subjects, scans, jobs and rigs over HTTP.

with Client("http://127.0.0.1:8765") as client:
    subject = client.create_subject("Ada")
    client.add_capture(subject.id, Path("neutral.obj"), role="neutral")
    job = client.run("build_model", subject.id)
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx
from httpx_sse import ServerSentEvent, connect_sse

from myoface import transfer
from myoface.connection import Patience, checked, once, patiently
from myoface.credentials import key_for
from myoface.errors import ApiError
from myoface.resources import (
    FINAL_STATES,
    Artifact,
    Capture,
    Frame,
    Job,
    Kind,
    LogLine,
    Progress,
    Resource,
    Rig,
    Role,
    Subject,
    Template,
    Upload,
)
from myoface.transfer import Transferred, unheard

DEFAULT_URL = "http://127.0.0.1:8765"
LONGEST_PAGE = 1000
"""The service lists at most so many things at a time."""
FRAMES_A_PAGE = 100
FRAMES_PAUSE = 0.5

TIMEOUT = httpx.Timeout(30.0)
# The service sends a comment line at least this often while a job has nothing to tell.
EVENTS_TIMEOUT = httpx.Timeout(30.0, read=60.0)

R = TypeVar("R", bound=Resource)
Watcher = Callable[[Job], None]
"""Called with the job whenever its state or progress has changed."""


def unwatched(_job: Job, /) -> None:
    """Let a job run without looking."""


class Client:
    """One service. Every method raises :class:`ApiError` with the service's problem document."""

    def __init__(self, url: str = DEFAULT_URL, key: str | None = None) -> None:
        """Speak to the service at ``url``; ``key`` is by default :func:`key_for` it."""
        key = key or key_for(url)
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self.http = httpx.Client(base_url=url, headers=headers, timeout=TIMEOUT, trust_env=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self.http.close()

    # Templates and subjects

    def create_template(
        self, name: str, path: Path, *, progress: Transferred = unheard
    ) -> Template:
        """Upload a template anatomy (NPZ) and register it."""
        upload = self.upload(path, progress=progress)
        return self._post("/v1/templates", Template, name=name, upload_id=upload.id)

    def templates(self) -> list[Template]:
        """Return the template anatomies, newest first."""
        return self._list("/v1/templates", Template)

    def create_subject(self, name: str, *, template_id: str | None = None) -> Subject:
        """Register a person; without a template the built-in anatomy is used."""
        return self._post("/v1/subjects", Subject, name=name, template_id=template_id)

    def subjects(self) -> list[Subject]:
        """Return the subjects, newest first."""
        return self._list("/v1/subjects", Subject)

    def subject(self, subject_id: str) -> Subject:
        """Return one subject."""
        return self._get(f"/v1/subjects/{subject_id}", Subject)

    def delete_subject(self, subject_id: str) -> None:
        """Delete a subject with all its scans, jobs and rigs."""
        self._send("DELETE", f"/v1/subjects/{subject_id}")

    # Files

    def upload(
        self,
        path: Path,
        *,
        resume: str | None = None,
        started: Callable[[str], None] | None = None,
        progress: Transferred = unheard,
    ) -> Upload:
        """Send a file, resuming over broken connections; see :func:`myoface.transfer.upload`."""
        return transfer.upload(self.http, path, resume=resume, started=started, progress=progress)

    def download(self, artifact: Artifact, path: Path, *, progress: Transferred = unheard) -> None:
        """Fetch an artifact, resumed and checked; see :func:`myoface.transfer.download`."""
        transfer.download(self.http, artifact, path, progress=progress)

    def add_capture(
        self,
        subject_id: str,
        path: Path,
        *,
        role: Role = "expression",
        name: str | None = None,
        registered: bool = True,
        landmarks: Path | None = None,
        resume: str | None = None,
        started: Callable[[str], None] | None = None,
        progress: Transferred = unheard,
    ) -> Capture:
        """Upload a scan and add it to a subject, named like the file unless ``name`` is given.

        ``registered`` is false for what comes from the scanner; ``landmarks`` is a file.
        """
        marks = None if landmarks is None else self.upload(landmarks).id
        sent = self.upload(path, resume=resume, started=started, progress=progress)
        return self._post(
            f"/v1/subjects/{subject_id}/captures",
            Capture,
            name=name or path.stem,
            role=role,
            upload_id=sent.id,
            registered=registered,
            landmarks_upload_id=marks,
        )

    def captures(self, subject_id: str) -> list[Capture]:
        """Return a subject's scans, newest first."""
        return self._list(f"/v1/subjects/{subject_id}/captures", Capture)

    def capture(self, subject_id: str, capture_id: str) -> Capture:
        """Return one scan, with its newest check and registration."""
        return self._get(f"/v1/subjects/{subject_id}/captures/{capture_id}", Capture)

    def set_landmarks(self, subject_id: str, capture_id: str, path: Path) -> Capture:
        """Upload landmarks on a scan, in place of those it had."""
        url = f"/v1/subjects/{subject_id}/captures/{capture_id}/landmarks"
        body = {"upload_id": self.upload(path).id}
        return Capture.model_validate(self._send("PUT", url, json=body).json())

    def delete_capture(self, subject_id: str, capture_id: str) -> None:
        """Delete a scan with its checks and registrations."""
        self._send("DELETE", f"/v1/subjects/{subject_id}/captures/{capture_id}")

    # Jobs

    def submit(
        self,
        kind: Kind,
        subject_id: str,
        *,
        captures: Iterable[str] = (),
        rig_id: str | None = None,
        options: dict[str, Any] | None = None,
    ) -> Job:
        """Queue a job. The id is made here, so that a repeated request can not queue it twice."""
        body = {
            "kind": kind,
            "subject_id": subject_id,
            "captures": list(captures),
            "rig_id": rig_id,
            "options": options,
        }
        body = {key: value for key, value in body.items() if value}
        url = f"/v1/jobs/{uuid.uuid4()}"
        return Job.model_validate(patiently(self.http, "PUT", url, json=body).json())

    def run(
        self, kind: Kind, subject_id: str, *, watch: Watcher = unwatched, **request: Any
    ) -> Job:
        """Submit a job and wait for it; see :meth:`submit` and :meth:`wait`."""
        return self.wait(self.submit(kind, subject_id, **request).id, watch)

    def job(self, job_id: str) -> Job:
        """Return a job as it stands."""
        return self._get(f"/v1/jobs/{job_id}", Job)

    def jobs(self, **filters: str | None) -> list[Job]:
        """Return jobs, newest first, filtered by subject_id, capture_id, state or kind."""
        return self._list("/v1/jobs", Job, **filters)

    def log(self, job_id: str, *, after: int = 0) -> Iterator[LogLine]:
        """Yield what the solver printed so far, the lines numbered higher than ``after``."""
        while True:
            page = self._send("GET", f"/v1/jobs/{job_id}/log", params={"after": after}).json()
            yield from map(LogLine.model_validate, page["lines"])
            if page["next"] == after:
                return
            after = page["next"]

    def frames(self, job_id: str, *, start: int = 0, follow: bool = False) -> Iterator[Frame]:
        """Yield the frames of a sequence that are ready, from the ``start``-th on.

        With ``follow``, wait for more until the job has ended, however it ends.
        """
        url = f"/v1/jobs/{job_id}"
        while True:
            job = Job.model_validate(patiently(self.http, "GET", url).json())
            query = {"start": start, "limit": FRAMES_A_PAGE}
            page = patiently(self.http, "GET", f"{url}/frames", params=query).json()
            yield from map(Frame.model_validate, page["frames"])
            if page["next"] > start:
                start = page["next"]
            elif not follow or job.state in FINAL_STATES:
                return
            else:
                time.sleep(FRAMES_PAUSE)

    def cancel(self, job_id: str, reason: str) -> Job:
        """Ask for a job to be stopped."""
        return self._post(f"/v1/jobs/{job_id}/cancel", Job, reason=reason)

    def wait(self, job_id: str, watch: Watcher = unwatched) -> Job:
        """Follow a job by its events until it has ended, through broken connections.

        Returns the succeeded job; raises :class:`ApiError` with the job's own error document
        if it failed or was canceled.
        """
        patience = Patience()
        while True:
            job = Job.model_validate(patiently(self.http, "GET", f"/v1/jobs/{job_id}").json())
            watch(job)
            if job.state in FINAL_STATES:
                return _succeeded(job)
            with patience.retrying():
                for event in self._events(job_id, job.last_event_id):
                    patience.reset()
                    if event.event != "progress":
                        break  # the state has changed: read the whole job again
                    watch(
                        job.model_copy(update={"progress": Progress.model_validate(event.json())})
                    )

    def _events(self, job_id: str, after: int) -> Iterator[ServerSentEvent]:
        headers = {"Last-Event-ID": str(after)}
        url = f"/v1/jobs/{job_id}/events"
        with connect_sse(self.http, "GET", url, headers=headers, timeout=EVENTS_TIMEOUT) as source:
            checked(source.response)
            yield from source.iter_sse()

    # Rigs

    def rigs(self, *, subject_id: str | None = None) -> list[Rig]:
        """Return rigs, newest first, those of one subject if it is given."""
        return self._list("/v1/rigs", Rig, subject_id=subject_id)

    def rig(self, rig_id: str) -> Rig:
        """Return one rig."""
        return self._get(f"/v1/rigs/{rig_id}", Rig)

    # Requests

    def _send(self, method: str, url: str, **request: Any) -> httpx.Response:
        return once(self.http, method, url, **request)

    def _get(self, url: str, kind: type[R], /) -> R:
        return kind.model_validate(self._send("GET", url).json())

    def _post(self, url: str, kind: type[R], /, **body: Any) -> R:
        given = {key: value for key, value in body.items() if value is not None}
        return kind.model_validate(self._send("POST", url, json=given).json())

    def _list(self, url: str, kind: type[R], /, **query: Any) -> list[R]:
        given = {key: value for key, value in query.items() if value is not None}
        found: list[R] = []
        while True:
            page = self._send("GET", url, params={"limit": LONGEST_PAGE, **given}).json()
            found += map(kind.model_validate, page["items"])
            if page.get("next") is None:
                return found
            given["cursor"] = page["next"]


def _succeeded(job: Job) -> Job:
    if job.state == "succeeded":
        return job
    why = f": {job.cancel.reason}" if job.cancel and job.cancel.reason else ""
    ended = {"code": f"job.{job.state}", "detail": f"{job.kind} job {job.id} was {job.state}{why}"}
    raise ApiError(job.error or ended)
