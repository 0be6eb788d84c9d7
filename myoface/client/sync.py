"""The client whose calls block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx

from myoface.client._drivers import drive
from myoface.client._operations import (
    DEFAULT_URL,
    BatchWatcher,
    Operations,
    Watcher,
    unwatched,
    unwatched_batch,
)
from myoface.connection import Flow
from myoface.credentials import headers_for
from myoface.resources import (
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
from myoface.trust import trust

TIMEOUT = httpx.Timeout(30.0)

R = TypeVar("R")


class Client:
    """One service. Every method raises :class:`ApiError` with the service's problem document.

    Requests are repeated where that does no harm: over a broken line, while the service is not
    ready, and as late as it asks for when it is asked too fast.
    """

    def __init__(
        self, url: str = DEFAULT_URL, key: str | None = None, *, ca: Path | str | None = None
    ) -> None:
        """Speak to the service at ``url``.

        ``key`` is by default what `myoface.credentials` has; ``ca`` is the PEM file of the
        authority that its certificate is of, where that is no public one (`myoface.trust`).
        """
        self.http = httpx.Client(
            base_url=url,
            headers=headers_for(url, key),
            timeout=TIMEOUT,
            trust_env=False,
            verify=trust(ca),
        )
        self._ask = Operations(url)

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

    # Whose key, and what it may use

    def me(self) -> Me:
        """Return whose key this client has."""
        return self._run(self._ask.me())

    def usage(self) -> Usage:
        """Return what the tenant uses, and its quotas."""
        return self._run(self._ask.usage())

    def keys(self) -> list[Key]:
        """Return the tenant's API keys, newest first."""
        return self._run(self._ask.keys())

    def create_key(
        self, name: str, scopes: Iterable[Scope], *, expires_at: datetime | None = None
    ) -> NewKey:
        """Make an API key; its text is told this once. ``expires_at`` has a time zone."""
        return self._run(self._ask.create_key(name, scopes, expires_at))

    def rotate_key(self, key_id: str, *, grace: int = 24 * 3600) -> NewKey:
        """Replace an API key; the old one goes on for ``grace`` seconds."""
        return self._run(self._ask.rotate_key(key_id, grace))

    def revoke_key(self, key_id: str) -> None:
        """Take an API key back at once."""
        self._run(self._ask.revoke_key(key_id))

    def audit(self, object_id: str | None = None) -> list[AuditEntry]:
        """Return what was done with the tenant's keys, newest first."""
        return self._run(self._ask.audit(object_id))

    # Templates and subjects

    def create_template(
        self, name: str, path: Path, *, progress: Transferred = unheard
    ) -> Template:
        """Upload a template anatomy (NPZ) and register it."""
        return self._run(self._ask.create_template(name, path, progress))

    def templates(self) -> list[Template]:
        """Return the template anatomies, newest first."""
        return self._run(self._ask.templates())

    def delete_template(self, template_id: str) -> str:
        """Delete a template that no subject has; returns the id of the receipt."""
        return self._run(self._ask.delete_template(template_id))

    def create_subject(self, name: str, *, template_id: str | None = None) -> Subject:
        """Register a person; without a template the built-in anatomy is used."""
        return self._run(self._ask.create_subject(name, template_id))

    def subjects(self) -> list[Subject]:
        """Return the subjects, newest first."""
        return self._run(self._ask.subjects())

    def subject(self, subject_id: str) -> Subject:
        """Return one subject."""
        return self._run(self._ask.subject(subject_id))

    def delete_subject(self, subject_id: str, *, cancel: bool = False) -> str:
        """Delete a subject with all its scans, jobs and rigs; returns the id of the receipt.

        ``cancel`` stops its jobs first; without it a subject with jobs is refused.
        """
        return self._run(self._ask.delete_subject(subject_id, cancel))

    def deletion(self, deletion_id: str) -> Deletion:
        """Return the receipt of a deletion."""
        return self._run(self._ask.deletion(deletion_id))

    # Files

    def upload(self, path: Path, *, progress: Transferred = unheard) -> Upload:
        """Send a file, going on with what was interrupted; see :func:`myoface.transfer.upload`."""
        return self._run(self._ask.upload(path, progress))

    def download(self, artifact: Artifact, path: Path, *, progress: Transferred = unheard) -> None:
        """Fetch an artifact, resumed and checked; see :func:`myoface.transfer.download`."""
        self._run(self._ask.download(artifact, path, progress))

    def signed_url(self, artifact_id: str) -> str:
        """Return a URL of a file that works without a key for a few minutes."""
        return self._run(self._ask.signed_url(artifact_id))

    def add_capture(
        self,
        subject_id: str,
        path: Path,
        *,
        role: Role = "expression",
        name: str | None = None,
        registered: bool = True,
        landmarks: Path | None = None,
        progress: Transferred = unheard,
    ) -> Capture:
        """Upload a scan and add it to a subject, named like the file unless ``name`` is given.

        ``registered`` is false for what comes from the scanner; ``landmarks`` is a file.
        """
        return self._run(
            self._ask.add_capture(
                subject_id,
                path,
                role=role,
                name=name,
                registered=registered,
                landmarks=landmarks,
                progress=progress,
            )
        )

    def captures(self, subject_id: str) -> list[Capture]:
        """Return a subject's scans, newest first."""
        return self._run(self._ask.captures(subject_id))

    def capture(self, subject_id: str, capture_id: str) -> Capture:
        """Return one scan, with its newest check and registration."""
        return self._run(self._ask.capture(subject_id, capture_id))

    def set_landmarks(self, subject_id: str, capture_id: str, path: Path) -> Capture:
        """Upload landmarks on a scan, in place of those it had."""
        return self._run(self._ask.set_landmarks(subject_id, capture_id, path))

    def delete_capture(self, subject_id: str, capture_id: str) -> str:
        """Delete a scan with its checks and registrations; returns the id of the receipt."""
        return self._run(self._ask.delete_capture(subject_id, capture_id))

    # Jobs

    def solvers(self) -> list[JobKind]:
        """Return the kinds of job with their options."""
        return self._run(self._ask.solvers())

    def submit(
        self,
        kind: Kind,
        subject_id: str,
        *,
        captures: Iterable[str] = (),
        rig_id: str | None = None,
        options: dict[str, Any] | None = None,
        priority: int = 0,
    ) -> Job:
        """Queue a job, once, however often the line breaks; a higher priority is done first."""
        return self._run(self._ask.submit(kind, subject_id, captures, rig_id, options, priority))

    def run(
        self, kind: Kind, subject_id: str, *, watch: Watcher = unwatched, **request: Any
    ) -> Job:
        """Submit a job and wait for it; see :meth:`submit` and :meth:`wait`."""
        return self.wait(self.submit(kind, subject_id, **request).id, watch)

    def retry(
        self,
        job_id: str,
        *,
        captures: Iterable[str] | None = None,
        options: dict[str, Any] | None = None,
        priority: int | None = None,
    ) -> Job:
        """Queue a job that is over once more; what is not given stays as it was."""
        return self._run(self._ask.retry(job_id, captures, options, priority))

    def job(self, job_id: str) -> Job:
        """Return a job as it stands."""
        return self._run(self._ask.job(job_id))

    def jobs(self, **filters: str | None) -> list[Job]:
        """Return jobs, newest first, filtered by subject_id, capture_id, state or kind."""
        return self._run(self._ask.jobs(**filters))

    def log(self, job_id: str, *, after: int = 0) -> Iterator[LogLine]:
        """Yield what the solver printed so far, the lines numbered higher than ``after``."""
        while lines := self._run(self._ask.log(job_id, after)):
            yield from lines
            after = lines[-1].number

    def frames(
        self, job_id: str, *, start: int = 0, follow: bool = False
    ) -> Iterator[Frame | MotionFrame]:
        """Yield the frames of a sequence or simulation that are ready, from the ``start``-th on.

        With ``follow``, wait for more until the job has ended, however it ends.
        """
        while found := self._run(self._ask.frames(job_id, start, follow)):
            yield from found
            start += len(found)

    def cancel(self, job_id: str, reason: str) -> Job:
        """Ask for a job to be stopped."""
        return self._run(self._ask.cancel(job_id, reason))

    def wait(self, job_id: str, watch: Watcher = unwatched) -> Job:
        """Follow a job by its events until it has ended, through broken connections.

        Returns the succeeded job; raises :class:`ApiError` with the job's own error document
        if it failed or was canceled.
        """
        return self._run(self._ask.wait(job_id, watch))

    # Batches

    def create_batch(
        self,
        neutral: Path | None,
        expressions: Iterable[Path] = (),
        *,
        subject_id: str | None = None,
        person: str | None = None,
        registered: bool = False,
        then: Iterable[Then] = ("register", "model", "geometry"),
        options: dict[str, dict[str, Any]] | None = None,
        priority: int = 0,
        progress: Transferred = unheard,
    ) -> Batch:
        """Upload a session's scans, each named like its file, and make of them what ``then`` says.

        They are the scans of the subject ``subject_id``, or of a new one named ``person``.
        ``options`` are those of the jobs, by kind.
        """
        return self._run(
            self._ask.create_batch(
                neutral,
                expressions,
                subject_id=subject_id,
                person=person,
                registered=registered,
                then=then,
                options=options,
                priority=priority,
                progress=progress,
            )
        )

    def batches(self, *, subject_id: str | None = None) -> list[Batch]:
        """Return batches, newest first, those of one subject if it is given."""
        return self._run(self._ask.batches(subject_id))

    def batch(self, batch_id: str) -> Batch:
        """Return a batch as it stands, with the verdict of each scan."""
        return self._run(self._ask.batch(batch_id))

    def cancel_batch(self, batch_id: str, reason: str) -> Batch:
        """Stop a batch and its jobs."""
        return self._run(self._ask.cancel_batch(batch_id, reason))

    def wait_for_batch(self, batch_id: str, watch: BatchWatcher = unwatched_batch) -> Batch:
        """Wait until a batch has ended; raises :class:`ApiError` if it did not succeed."""
        return self._run(self._ask.wait_for_batch(batch_id, watch))

    # Rigs

    def rigs(self, *, subject_id: str | None = None) -> list[Rig]:
        """Return rigs, newest first, those of one subject if it is given."""
        return self._run(self._ask.rigs(subject_id))

    def rig(self, rig_id: str) -> Rig:
        """Return one rig."""
        return self._run(self._ask.rig(rig_id))

    def _run(self, flow: Flow[R]) -> R:
        return drive(self.http, flow)
