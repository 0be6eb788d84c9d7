"""The calls about jobs, batches and rigs, and the client with all calls of the service."""

from __future__ import annotations

import dataclasses
import os
import uuid
import warnings
from collections.abc import AsyncIterator, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import anyio
import httpx

from myoface.client.aio_live import AsyncLiveSessions
from myoface.client.answers import CHANGED, read_json
from myoface.client.archive import (
    PACKED,
    async_check_archive,
    async_is_unpacked,
    async_unpack,
    read_archive,
    read_note,
)
from myoface.client.files import Transferred, ignore_transfer, part_path
from myoface.client.jobs import (
    BatchWatcher,
    EventReader,
    Watcher,
    by_origin,
    read_frame,
    require_batch,
    require_job,
    unwatched,
    unwatched_batch,
)
from myoface.client.retry import Backoff, requested_pause
from myoface.errors import ApiError
from myoface.names import name_session
from myoface.resources import (
    FINAL_STATES,
    Artifact,
    Batch,
    Frame,
    FramePage,
    FromJob,
    Job,
    JobItem,
    JobKind,
    LabelChanges,
    LabelFilter,
    LogLine,
    LogPage,
    MotionFrame,
    Progress,
    Rig,
    RigItem,
    Then,
    WholeRig,
    as_query,
)
from myoface.roles import NO_SCANS

TOO_MANY_STREAMS = "stream.too_many"


class AsyncClient(AsyncLiveSessions):
    """One service. Every method raises :class:`ApiError` with the service's problem document.

    Requests are repeated where that does no harm: over a broken line, while the service is not
    ready, and as late as it asks for when it is asked too fast.
    """

    # Jobs

    async def kinds(self) -> list[JobKind]:
        """Return the kinds of job with their options."""
        return await self._list("/v1/kinds", JobKind)

    async def solvers(self) -> list[JobKind]:
        """Return the kinds of job; the old name of :meth:`kinds`, for one more release."""
        warnings.warn("solvers() is called kinds() now", DeprecationWarning, stacklevel=2)
        return await self.kinds()

    async def submit(
        self,
        kind: str,
        subject_id: str,
        *,
        captures: Iterable[str | Artifact | FromJob] = (),
        rig_id: str | None = None,
        options: dict[str, Any] | None = None,
        priority: int = 0,
    ) -> Job:
        """Queue a job, once, however often the line breaks; a higher priority is done first.

        ``captures`` are ids of captures, and files that earlier jobs left:
        ``check.result["markers.json"]``, or a :class:`FromJob` with its name in a scene.
        """
        body = {
            "kind": kind,
            "subject_id": subject_id,
            **by_origin(captures),
            "rig_id": rig_id,
            "options": options,
            "priority": priority,
        }
        given = {key: value for key, value in body.items() if value}
        response = await self._request("PUT", f"/v1/jobs/{uuid.uuid4()}", json=given)
        return Job.read(read_json(response))

    async def run(
        self, kind: str, subject_id: str, *, watch: Watcher = unwatched, **request: Any
    ) -> Job:
        """Submit a job and wait for it; see :meth:`submit` and :meth:`wait`."""
        job = await self.submit(kind, subject_id, **request)
        return await self.wait(job.id, watch)

    async def retry(
        self,
        job_id: str,
        *,
        captures: Iterable[str | Artifact | FromJob] | None = None,
        options: dict[str, Any] | None = None,
        priority: int | None = None,
    ) -> Job:
        """Queue a job that is over once more; what is not given stays as it was."""
        return await self._create(
            f"/v1/jobs/{job_id}/retry",
            Job,
            **({} if captures is None else by_origin(captures)),
            options=options,
            priority=priority,
        )

    async def job(self, job_id: str) -> Job:
        """Return a job as it stands."""
        return await self._get(f"/v1/jobs/{job_id}", Job)

    async def jobs(self, **filters: str | None) -> list[JobItem]:
        """Return jobs in short, newest first, filtered by subject_id, capture_id, state or kind."""
        return await self._list("/v1/jobs", JobItem, **filters)

    async def log(self, job_id: str, *, after: int = 0) -> AsyncIterator[LogLine]:
        """Yield what the solver printed so far, the lines numbered higher than ``after``."""
        url = f"/v1/jobs/{job_id}/log"
        while True:
            page = await self._get(url, LogPage, params={"after": after})
            lines = page.lines
            if not lines:
                return
            for line in lines:
                yield line
            after = lines[-1].number

    async def frames(
        self, job_id: str, *, start: int = 0, follow: bool = False
    ) -> AsyncIterator[Frame | MotionFrame]:
        """Yield the frames of a sequence or simulation that are ready, from the ``start``-th on.

        With ``follow``, wait for more until the job has ended, however it ends.
        """
        url = f"/v1/jobs/{job_id}"
        while True:
            query = {"start": start, "limit": self._options.frame_page_items}
            # The job first: the frames of one that had ended by then are all there.
            job = await self._watch(url, Job)
            page = await self._watch(f"{url}/frames", FramePage, params=query)
            frames = list(map(read_frame, page.frames))
            for frame in frames:
                yield frame
            start += len(frames)
            if not frames:
                if not follow or job.state in FINAL_STATES:
                    return
                await anyio.sleep(self._options.frame_pause_s)

    async def cancel(self, job_id: str, reason: str) -> Job:
        """Ask for a job to be stopped."""
        url = f"/v1/jobs/{job_id}/cancel"
        response = await self._request_once("POST", url, json={"reason": reason})
        return Job.read(read_json(response))

    async def wait(self, job_id: str, watch: Watcher = unwatched) -> Job:
        """Follow a job by its events until it has ended, through broken connections.

        Returns the succeeded job; raises :class:`ApiError` with the job's own error document
        if it failed or was canceled.
        """
        options = self._options
        backoff = Backoff(options, options.wait_s)
        while True:
            job = await self._watch(f"/v1/jobs/{job_id}", Job)
            watch(job)
            if job.state in FINAL_STATES:
                return require_job(job)
            try:
                if not await self._follow(job, watch, backoff):
                    await anyio.sleep(options.stream_pause_s)  # a proxy may end them at once
            except ApiError as error:
                if error.code == TOO_MANY_STREAMS:
                    # Asking again and again does as well.
                    pause = requested_pause(error) or options.stream_pause_s
                    await anyio.sleep(min(pause, options.longest_wish_s))
                else:
                    await anyio.sleep(backoff.pause_if_transient(error))

    async def _follow(self, job: Job, watch: Watcher, backoff: Backoff) -> bool:
        """Report a job's progress to ``watch`` until its state changes; tell if anything came."""
        came = False
        options = self._options
        reader = EventReader()
        headers = {"Last-Event-ID": str(job.last_event_id)}
        timeout = httpx.Timeout(options.timeout_s, read=options.events_timeout_s)
        url = f"/v1/jobs/{job.id}/events"
        async with self._stream(url, headers=headers, timeout=timeout) as response:
            async for content in response.aiter_bytes():
                for event in reader.read(content):
                    backoff.reset()
                    came = True
                    if event.kind != "progress":
                        return came
                    progress = Progress.read(event.data)
                    watch(dataclasses.replace(job, progress=progress))
        return came

    # Batches

    async def create_batch(
        self,
        neutral: Path | None,
        expressions: Iterable[Path] = (),
        *,
        subject_id: str | None = None,
        person: str | None = None,
        registered: bool = False,
        then: Iterable[Then] = ("register", "model", "geometry"),
        options: dict[str, dict[str, Any]] | None = None,
        landmarks: Mapping[Path, Path] | None = None,
        priority: int = 0,
        progress: Transferred = ignore_transfer,
    ) -> Batch:
        """Upload a session's scans, each named like its file, and make of them what ``then`` says.

        They are the scans of the subject ``subject_id``, or of a new one named ``person``. Without
        ``neutral`` the one whose name says so is the neutral. ``options`` are those of the jobs, by
        kind; ``landmarks`` are files, by the scan's.
        """
        marks = {path.resolve(): file for path, file in (landmarks or {}).items()}
        captures = []
        scans = name_session(neutral, expressions)
        if registered:
            await self._require_vertices(scans, subject_id)
        for scan in scans:
            its = marks.get(scan.path.resolve())
            packed = scan.role not in NO_SCANS and not registered
            captures.append(
                {
                    "name": scan.name,
                    "role": scan.role,
                    "upload_id": await self._upload_scan(scan.path, progress, packed=packed),
                    "registered": registered or scan.role in NO_SCANS,
                    "landmarks_upload_id": its and (await self.upload(its)).id,
                }
            )
        return await self._create(
            "/v1/batches",
            Batch,
            subject_id=subject_id,
            subject=None if person is None else {"name": person},
            captures=captures,
            then=list(then),
            options=options,
            priority=priority,
        )

    async def batches(self, *, subject_id: str | None = None) -> list[Batch]:
        """Return batches, newest first, those of one subject if it is given."""
        return await self._list("/v1/batches", Batch, subject_id=subject_id)

    async def batch(self, batch_id: str) -> Batch:
        """Return a batch as it stands, with the verdict of each scan."""
        return await self._get(f"/v1/batches/{batch_id}", Batch)

    async def cancel_batch(self, batch_id: str, reason: str) -> Batch:
        """Stop a batch and its jobs."""
        url = f"/v1/batches/{batch_id}/cancel"
        response = await self._request_once("POST", url, json={"reason": reason})
        return Batch.read(read_json(response))

    async def wait_for_batch(self, batch_id: str, watch: BatchWatcher = unwatched_batch) -> Batch:
        """Wait until a batch has ended; raises :class:`ApiError` if it did not succeed."""
        while True:
            batch = await self._watch(f"/v1/batches/{batch_id}", Batch)
            watch(batch)
            if batch.state != "running":
                return require_batch(batch)
            await anyio.sleep(self._options.batch_pause_s)

    # Rigs

    async def rigs(
        self, *, subject_id: str | None = None, labels: LabelFilter | None = None
    ) -> list[RigItem]:
        """Return rigs in short, newest first, of one subject and with ``labels`` if they are given.

        A label of None has any value. :meth:`rig` has the files and figures of each.
        """
        query = {"subject_id": subject_id, "label": as_query(labels)}
        return await self._list("/v1/rigs", RigItem, **query)

    async def rig(self, rig_id: str) -> Rig:
        """Return one rig."""
        return await self._get(f"/v1/rigs/{rig_id}", Rig)

    async def change_rig(
        self, rig_id: str, *, name: str | None = None, labels: LabelChanges | None = None
    ) -> Rig:
        """Give a rig a name or labels; a label of None goes, those not named stay."""
        return await self._change(f"/v1/rigs/{rig_id}", Rig, name=name, labels=labels)

    async def download_rig(
        self, rig_id: str, folder: Path, *, progress: Transferred = ignore_transfer
    ) -> WholeRig:
        """Fetch a rig whole, with its model, and unpack it into ``folder``.

        ``rig.json``, written last, says whose rig it is and names all files. A folder that has them
        all is left as it is, and one that was begun is gone on with.
        """
        archive = await self._find_archive(rig_id)
        if not await async_is_unpacked(folder, archive):
            packed = folder / PACKED
            archive = await self._fetch_archive(rig_id, archive, packed, progress)
            try:
                await async_unpack(packed, folder, archive)
            finally:
                packed.unlink()
        return read_note(folder)

    async def download_archive(
        self, rig_id: str, path: Path, *, progress: Transferred = ignore_transfer
    ) -> None:
        """Fetch a rig whole, with its model, as one ZIP file; see :meth:`download`."""
        await self._fetch_archive(rig_id, await self._find_archive(rig_id), path, progress)

    async def _find_archive(self, rig_id: str) -> Artifact:
        """Return size and tag of a rig's archive as it is now.

        For a HEAD the service reads no file; for the first byte it would read them all.
        """
        url = f"/v1/rigs/{rig_id}/archive"
        try:
            answer = await self._request("HEAD", url)
        except ApiError as error:
            if error.status is not None:  # the answer to a HEAD has no words, that to a GET has
                await self._request("GET", url, headers={"Range": "bytes=0-0"})
            raise
        return read_archive(answer, rig_id)

    async def _fetch_archive(
        self, rig_id: str, archive: Artifact, path: Path, progress: Transferred
    ) -> Artifact:
        """Fetch an archive; return the one it is, another if the rig has changed meanwhile."""
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            with suppress(ApiError):
                await async_check_archive(path, archive)
                return archive
        part = part_path(path, archive)
        backoff = Backoff(self._options)
        while True:
            try:
                await self._fetch(f"/v1/rigs/{rig_id}/archive", part, archive, progress)
                break
            except ApiError as error:
                if error.code != CHANGED:
                    raise
                part.unlink()
                await anyio.sleep(backoff.pause_after(error))
                archive = await self._find_archive(rig_id)
                part = part_path(path, archive)
        try:
            await async_check_archive(part, archive)
        except ApiError:
            part.unlink()
            raise
        os.replace(part, path)
        return archive
