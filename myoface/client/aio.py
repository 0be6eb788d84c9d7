"""The client whose calls are awaited."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable
from datetime import datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import anyio
import httpx

from myoface.client._operations import DEFAULT_URL, Operations, Watcher, unwatched
from myoface.connection import Flow, Open, Pause, Read, Send, Step, Work, unreachable
from myoface.credentials import headers_for
from myoface.errors import ApiError
from myoface.resources import (
    Artifact,
    AuditEntry,
    Capture,
    Deletion,
    Frame,
    Job,
    Key,
    Kind,
    LogLine,
    Me,
    NewKey,
    Rig,
    Role,
    Scope,
    Subject,
    Template,
    Upload,
    Usage,
)
from myoface.transfer import Transferred, unheard

TIMEOUT = httpx.Timeout(30.0)

R = TypeVar("R")


class AsyncClient:
    """One service, as :class:`myoface.client.Client` has it, for asyncio and trio."""

    def __init__(self, url: str = DEFAULT_URL, key: str | None = None) -> None:
        """Speak to the service at ``url``; ``key`` is by default what `myoface.credentials` has."""
        self.http = httpx.AsyncClient(
            base_url=url, headers=headers_for(url, key), timeout=TIMEOUT, trust_env=False
        )
        self._ask = Operations(url)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self.http.aclose()

    # Whose key, and what it may use

    async def me(self) -> Me:
        """Return whose key this client has."""
        return await self._run(self._ask.me())

    async def usage(self) -> Usage:
        """Return what the tenant uses, and its quotas."""
        return await self._run(self._ask.usage())

    async def keys(self) -> list[Key]:
        """Return the tenant's API keys, newest first."""
        return await self._run(self._ask.keys())

    async def create_key(
        self, name: str, scopes: Iterable[Scope], *, expires_at: datetime | None = None
    ) -> NewKey:
        """Make an API key; its text is told this once. ``expires_at`` has a time zone."""
        return await self._run(self._ask.create_key(name, scopes, expires_at))

    async def rotate_key(self, key_id: str, *, grace: int = 24 * 3600) -> NewKey:
        """Replace an API key; the old one goes on for ``grace`` seconds."""
        return await self._run(self._ask.rotate_key(key_id, grace))

    async def revoke_key(self, key_id: str) -> None:
        """Take an API key back at once."""
        await self._run(self._ask.revoke_key(key_id))

    async def audit(self, object_id: str | None = None) -> list[AuditEntry]:
        """Return what was done with the tenant's keys, newest first."""
        return await self._run(self._ask.audit(object_id))

    # Templates and subjects

    async def create_template(
        self, name: str, path: Path, *, progress: Transferred = unheard
    ) -> Template:
        """Upload a template anatomy (NPZ) and register it."""
        return await self._run(self._ask.create_template(name, path, progress))

    async def templates(self) -> list[Template]:
        """Return the template anatomies, newest first."""
        return await self._run(self._ask.templates())

    async def delete_template(self, template_id: str) -> str:
        """Delete a template that no subject has; returns the id of the receipt."""
        return await self._run(self._ask.delete_template(template_id))

    async def create_subject(self, name: str, *, template_id: str | None = None) -> Subject:
        """Register a person; without a template the built-in anatomy is used."""
        return await self._run(self._ask.create_subject(name, template_id))

    async def subjects(self) -> list[Subject]:
        """Return the subjects, newest first."""
        return await self._run(self._ask.subjects())

    async def subject(self, subject_id: str) -> Subject:
        """Return one subject."""
        return await self._run(self._ask.subject(subject_id))

    async def delete_subject(self, subject_id: str, *, cancel: bool = False) -> str:
        """Delete a subject with all its scans, jobs and rigs; returns the id of the receipt.

        ``cancel`` stops its jobs first; without it a subject with jobs is refused.
        """
        return await self._run(self._ask.delete_subject(subject_id, cancel))

    async def deletion(self, deletion_id: str) -> Deletion:
        """Return the receipt of a deletion."""
        return await self._run(self._ask.deletion(deletion_id))

    # Files

    async def upload(self, path: Path, *, progress: Transferred = unheard) -> Upload:
        """Send a file, going on with what was interrupted; see :func:`myoface.transfer.upload`."""
        return await self._run(self._ask.upload(path, progress))

    async def download(
        self, artifact: Artifact, path: Path, *, progress: Transferred = unheard
    ) -> None:
        """Fetch an artifact, resumed and checked; see :func:`myoface.transfer.download`."""
        await self._run(self._ask.download(artifact, path, progress))

    async def signed_url(self, artifact_id: str) -> str:
        """Return a URL of a file that works without a key for a few minutes."""
        return await self._run(self._ask.signed_url(artifact_id))

    async def add_capture(
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
        return await self._run(
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

    async def captures(self, subject_id: str) -> list[Capture]:
        """Return a subject's scans, newest first."""
        return await self._run(self._ask.captures(subject_id))

    async def capture(self, subject_id: str, capture_id: str) -> Capture:
        """Return one scan, with its newest check and registration."""
        return await self._run(self._ask.capture(subject_id, capture_id))

    async def set_landmarks(self, subject_id: str, capture_id: str, path: Path) -> Capture:
        """Upload landmarks on a scan, in place of those it had."""
        return await self._run(self._ask.set_landmarks(subject_id, capture_id, path))

    async def delete_capture(self, subject_id: str, capture_id: str) -> str:
        """Delete a scan with its checks and registrations; returns the id of the receipt."""
        return await self._run(self._ask.delete_capture(subject_id, capture_id))

    # Jobs

    async def submit(
        self,
        kind: Kind,
        subject_id: str,
        *,
        captures: Iterable[str] = (),
        rig_id: str | None = None,
        options: dict[str, Any] | None = None,
    ) -> Job:
        """Queue a job, once, however often the line breaks."""
        return await self._run(self._ask.submit(kind, subject_id, captures, rig_id, options))

    async def run(
        self, kind: Kind, subject_id: str, *, watch: Watcher = unwatched, **request: Any
    ) -> Job:
        """Submit a job and wait for it; see :meth:`submit` and :meth:`wait`."""
        job = await self.submit(kind, subject_id, **request)
        return await self.wait(job.id, watch)

    async def job(self, job_id: str) -> Job:
        """Return a job as it stands."""
        return await self._run(self._ask.job(job_id))

    async def jobs(self, **filters: str | None) -> list[Job]:
        """Return jobs, newest first, filtered by subject_id, capture_id, state or kind."""
        return await self._run(self._ask.jobs(**filters))

    async def log(self, job_id: str, *, after: int = 0) -> AsyncIterator[LogLine]:
        """Yield what the solver printed so far, the lines numbered higher than ``after``."""
        while lines := await self._run(self._ask.log(job_id, after)):
            for line in lines:
                yield line
            after = lines[-1].number

    async def frames(
        self, job_id: str, *, start: int = 0, follow: bool = False
    ) -> AsyncIterator[Frame]:
        """Yield the frames of a sequence that are ready, from the ``start``-th on.

        With ``follow``, wait for more until the job has ended, however it ends.
        """
        while found := await self._run(self._ask.frames(job_id, start, follow)):
            for frame in found:
                yield frame
            start += len(found)

    async def cancel(self, job_id: str, reason: str) -> Job:
        """Ask for a job to be stopped."""
        return await self._run(self._ask.cancel(job_id, reason))

    async def wait(self, job_id: str, watch: Watcher = unwatched) -> Job:
        """Follow a job by its events until it has ended, through broken connections.

        Returns the succeeded job; raises :class:`ApiError` with the job's own error document
        if it failed or was canceled.
        """
        return await self._run(self._ask.wait(job_id, watch))

    # Rigs

    async def rigs(self, *, subject_id: str | None = None) -> list[Rig]:
        """Return rigs, newest first, those of one subject if it is given."""
        return await self._run(self._ask.rigs(subject_id))

    async def rig(self, rig_id: str) -> Rig:
        """Return one rig."""
        return await self._run(self._ask.rig(rig_id))

    async def _run(self, flow: Flow[R]) -> R:
        """Take a flow's steps until it returns."""
        line = _Line(self.http)
        answer: Any = None
        broken: ApiError | None = None
        try:
            while True:
                try:
                    step = flow.send(answer) if broken is None else flow.throw(broken)
                except StopIteration as end:
                    result: R = end.value
                    return result
                answer = broken = None
                try:
                    answer = await line.take(step)
                except httpx.TransportError as error:
                    broken = unreachable(error)
        finally:
            await line.close()
            flow.close()


class _Line:
    """Takes steps; what was opened is closed by the next step that does not read it."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self._http = http
        self._opened: httpx.Response | None = None
        self._blocks: AsyncIterator[bytes] | None = None

    async def take(self, step: Step) -> Any:
        if isinstance(step, Read):
            assert self._blocks is not None, "nothing was opened"
            return await anext(self._blocks, None)
        await self.close()
        match step:
            case Open():
                return await self._open(step)
            case Send():
                return await self._http.request(step.method, step.url, **step.options)
            case Pause():
                await anyio.sleep(step.seconds)
            case Work():
                return await anyio.to_thread.run_sync(step.function)
        return None

    async def close(self) -> None:
        if self._opened is not None:
            await self._opened.aclose()
            self._opened = None

    async def _open(self, step: Open) -> httpx.Response:
        request = self._http.build_request(step.method, step.url, **step.options)
        self._opened = response = await self._http.send(request, stream=True)
        if response.is_error:
            await response.aread()
        self._blocks = response.aiter_bytes()
        return response
