"""Job operations: submit, retry, cancel, read frames."""

from __future__ import annotations

import base64
import json
from typing import Any

from pydantic import ValidationError
from sqlalchemy.orm import Session

from service import tracing
from service.access.limits import check_bytes, check_queued
from service.errors import Problem, lost
from service.jobs import repository
from service.jobs.faces import refuse_unseen
from service.jobs.inputs import resolve
from service.jobs.options import check_options, find_kind
from service.jobs.schemas import Cancel, FramesView, NewJob, Retry
from service.queue import table
from service.queue.states import FINAL
from service.store.database import Store
from service.store.integrity import LostFileError, note_fault, open_checked
from service.store.models import FrameChunk, Job, new_id
from service.subjects import repository as subjects
from solver.kinds import KINDS

# Bytes of a file of frames, and of those read for an answer: 30 frames of a full face take 4 MB
LARGEST_CHUNK = 16 * 1024**2
MOST_READ = 16 * 1024**2
# Requests of a process that hold files of frames at a time: one takes some four times its bytes
FRAME_READERS = 2
# Values of one: vertices are packed, so that a frame has some hundred
MOST_VALUES = 1_000_000
# Files of frames, the newest, that are looked at for a picture
MOST_LOOKED_AT = 5


def check(store: Store, new: NewJob) -> None:
    """Refuse an order that cannot be, before anybody waits until it has been written."""
    find_kind(new.kind)
    with store.read() as session:
        subjects.get(session, new.subject_id)
    check_options(new.kind, new.options)


def exists(store: Store, job_id: str) -> bool:
    """Return whether the tenant has a job of this id."""
    with store.read() as session:
        return session.get(Job, job_id) is not None


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
    refuse_unseen(session, kind, new, inputs.files)
    job = Job(
        id=job_id or new_id(),
        subject_id=new.subject_id,
        kind=kind.name,
        queue=kind.given(new.options).queue,
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
        raise _finished(job)
    if not table.cancel(session, job_id, order.by, order.reason):
        session.refresh(job)
        if job.state in FINAL:  # it has ended just now
            raise _finished(job)


def frames_busy() -> Problem:
    """Return the problem of a request for frames beside which too many others read some."""
    problem = Problem(503, "frames.busy", "others are reading frames: ask again in a moment")
    problem.headers = {"Retry-After": "1"}
    return problem


def _finished(job: Job) -> Problem:
    state = job.state
    return Problem(409, "job.finished", f"the job is {state.value}", job_id=job.id, state=state)


def read_frames(session: Session, store: Store, job_id: str, start: int, limit: int) -> FramesView:
    """Return the frames from the ``start``-th on, at most ``limit``, of few large files fewer."""
    _check_frames(session, job_id)
    chunks = table.frames(session, job_id)
    found: list[Any] = []
    room = MOST_READ
    for chunk in chunks:
        if room <= 0 or len(found) >= limit:
            break
        if chunk.first < start + limit and chunk.last >= start:
            content = _read_chunk(store, chunk)
            room -= len(content)
            frames = _parse_chunk(chunk, content)["frames"]
            found += frames[max(start - chunk.first, 0) : start + limit - chunk.first]
    ready = chunks[-1].last + 1 if chunks else 0
    try:
        return FramesView(frames=found[:limit], next=start + len(found[:limit]), ready=ready)
    except ValidationError as error:
        raise _bad_frames(job_id) from error


def newest_picture(session: Session, store: Store, job_id: str) -> bytes | None:
    """Return a JPEG of the newest frame that has one, None before there is any."""
    _check_frames(session, job_id)
    for chunk in table.frames(session, job_id)[: -MOST_LOOKED_AT - 1 : -1]:
        picture = _parse_chunk(chunk, _read_chunk(store, chunk)).get("picture")
        if picture:
            try:
                return base64.b64decode(picture)
            except (TypeError, ValueError) as error:
                raise _bad_frames(job_id) from error
    return None


def _read_chunk(store: Store, chunk: FrameChunk) -> bytearray:
    """Return the bytes of a file of frames; a problem if it is lost, damaged or too large."""
    content = bytearray()
    try:
        for block in open_checked(store.files, chunk.sha256):
            if len(content) + len(block) > LARGEST_CHUNK:
                raise _bad_frames(chunk.job_id)
            content += block
    except LostFileError as error:
        note_fault(store, error.sha256, error.fault)
        raise lost(chunk.filename, error.fault, job_id=chunk.job_id) from error
    return content


def _parse_chunk(chunk: FrameChunk, content: bytearray) -> dict[str, Any]:
    """Return what a file of frames holds: a solver wrote it, which may have been taken over."""
    if content.count(b",") > MOST_VALUES:  # a list of numbers takes many times its text
        raise _bad_frames(chunk.job_id)
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise _bad_frames(chunk.job_id) from error
    if not isinstance(found, dict) or not isinstance(found.get("frames"), list):
        raise _bad_frames(chunk.job_id)
    return found


def _bad_frames(job_id: str) -> Problem:
    detail = "the solver left a file of frames that is too large, or holds no frames"
    return Problem(409, "job.bad_frames", detail, job_id=job_id)


def _check_frames(session: Session, job_id: str) -> None:
    job = repository.get(session, job_id)
    if not KINDS[job.kind].frames:
        raise Problem(409, "job.no_frames", f"a {job.kind} job has no frames", job_id=job_id)
