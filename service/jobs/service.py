"""Job operations: submit, retry, cancel, read frames."""

from __future__ import annotations

import base64
import json
from typing import Any

from sqlalchemy.orm import Session

from service import tracing
from service.access.limits import check_bytes, check_queued
from service.errors import Problem, lost
from service.jobs import repository
from service.jobs.inputs import resolve
from service.jobs.options import check_options, find_kind
from service.jobs.schemas import Cancel, NewJob, Retry
from service.queue import table
from service.queue.states import FINAL
from service.store.database import Store
from service.store.integrity import LostFileError, note_fault, open_checked
from service.store.models import FrameChunk, Job, new_id
from service.subjects import repository as subjects
from solver.kinds import KINDS


def check(store: Store, new: NewJob) -> None:
    """Refuse an order that cannot be, before anybody waits until it has been written."""
    find_kind(new.kind)
    with store.read() as session:
        subjects.get(session, new.subject_id)
    check_options(new.kind, new.options)


def submit(
    session: Session, new: NewJob, max_attempts: int, job_id: str | None = None, **origin: str
) -> tuple[Job, bool]:
    """Queue a job whose options were checked; returns it, and whether it is new.

    With ``job_id`` the call can be repeated: the same request finds the same job. ``origin`` is the
    ``parent_id`` or ``batch_id`` that the job comes from.
    """
    if job_id and (job := session.get(Job, job_id)):
        if NewJob.model_validate(job.request) != new:
            raise id_conflict(job_id)
        return job, False
    kind = find_kind(new.kind)
    subjects.get(session, new.subject_id)
    check_queued(session)
    check_bytes(session, 0)  # what jobs leave counts: no more of it beyond the quota
    subjects.lock(session, new.subject_id)
    inputs = resolve(session, kind, new)
    job = Job(
        id=job_id or new_id(),
        subject_id=new.subject_id,
        kind=kind.name,
        queue=kind.queue,
        request=new.model_dump(),
        inputs=inputs.files,
        capture_id=inputs.capture_id,
        model_job_id=inputs.model_job_id,
        max_attempts=max_attempts,
        priority=new.priority,
        memory_mb=new.memory_mb,
        **origin,
    )
    table.create(session, job)
    tracing.note(job_id=job.id)
    return job, True


def id_conflict(job_id: str) -> Problem:
    """Return the problem of an id that is in use."""
    return Problem(409, "job.conflict", "this id has another job already", job_id=job_id)


def retry(session: Session, job_id: str, wanted: Retry, max_attempts: int) -> Job:
    """Queue a job that is over once more, with other options and the inputs as they are now."""
    parent = repository.get(session, job_id)
    if parent.state not in FINAL:
        raise Problem(
            409,
            "job.not_over",
            f"the job is {parent.state.value}: it can be made again when it is over",
            job_id=job_id,
            state=parent.state,
        )
    changed = wanted.model_dump(exclude_none=True, exclude={"options"})
    options = {**parent.request["options"], **wanted.options}
    new = NewJob.model_validate({**parent.request, **changed, "options": options})
    check_options(new.kind, new.options)
    return submit(session, new, max_attempts, parent_id=parent.id)[0]


def cancel(session: Session, job_id: str, order: Cancel) -> None:
    """Ask for a job to stop; asking twice is as good as once."""
    job = repository.get(session, job_id)
    if job.state in FINAL:
        raise Problem(
            409, "job.finished", f"the job is {job.state.value}", job_id=job_id, state=job.state
        )
    table.cancel(session, job_id, order.by, order.reason)


def read_frames(
    session: Session, store: Store, job_id: str, start: int, limit: int
) -> tuple[list[dict[str, Any]], int]:
    """Return the frames from the ``start``-th on, at most ``limit``, and how many are ready."""
    _check_frames(session, job_id)
    chunks = table.frames(session, job_id)
    found: list[dict[str, Any]] = []
    for chunk in chunks:
        if chunk.first < start + limit and chunk.last >= start:
            frames = _read_chunk(store, chunk)["frames"]
            found += frames[max(start - chunk.first, 0) : start + limit - chunk.first]
    return found, chunks[-1].last + 1 if chunks else 0


def newest_picture(session: Session, store: Store, job_id: str) -> bytes | None:
    """Return a JPEG of the newest frame that has one, None before there is any."""
    _check_frames(session, job_id)
    for chunk in reversed(table.frames(session, job_id)):
        if picture := _read_chunk(store, chunk).get("picture"):
            return base64.b64decode(picture)
    return None


def _read_chunk(store: Store, chunk: FrameChunk) -> dict[str, Any]:
    """Return a file of frames; raises a problem if it is lost or damaged."""
    try:
        content: dict[str, Any] = json.loads(b"".join(open_checked(store.files, chunk.sha256)))
    except LostFileError as error:
        note_fault(store, error.sha256, error.fault)
        raise lost(chunk.filename, error.fault, job_id=chunk.job_id) from error
    return content


def _check_frames(session: Session, job_id: str) -> None:
    job = repository.get(session, job_id)
    if not KINDS[job.kind].frames:
        raise Problem(409, "job.no_frames", f"a {job.kind} job has no frames", job_id=job_id)
