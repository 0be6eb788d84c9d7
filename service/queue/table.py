"""The job table's rules: every change of state is one UPDATE that names the states it may leave.

A worker's updates also name its attempt: a worker that lost its lease changes nothing any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, delete, func, literal, or_, select, update
from sqlalchemy.orm import Session

from service.bounds import fit_progress
from service.queue import outbox
from service.queue.states import FINAL, HELD, State, before
from service.queue.wakeups import wake
from service.store.database import clock
from service.store.models import (
    Artifact,
    Attempt,
    Event,
    FrameChunk,
    Job,
    LogLine,
    Rig,
    Tenant,
    UtcDateTime,
)

WORKER_LOST = "worker_lost"
# Progress events kept of a job that is over
MOST_STEPS_KEPT = 200
# Of a running job: above the first, every other one goes; of one beat, the last are kept
MOST_STEPS = 2000
MOST_STEPS_OF_BEAT = 50
SHORTEST_WAIT = timedelta(seconds=5)
LONGEST_WAIT = timedelta(minutes=5)
# Corrections of a clock are shorter, and so is the time from reading it to reading a lease
LEAST_SETBACK = timedelta(seconds=10)
# Longest wait for room on a full disk before the job fails
WAIT_FOR_ROOM = timedelta(hours=1)


@dataclass(frozen=True)
class Claim:
    """A job as a worker holds it: ``attempt`` is the fence."""

    job_id: str
    tenant_id: str
    attempt: int
    kind: str
    subject_id: str
    inputs: list[dict[str, Any]]
    options: dict[str, Any]
    rig_id: str | None
    model_job_id: str | None
    frames: dict[str, str]
    """The frames that earlier attempts left: file name -> sha256."""
    kept: dict[str, str]
    """The other files that they left to go on with: name -> sha256."""
    deadline_s: int | None = None
    """The seconds after which whoever asked for it wants an attempt to end."""
    traceparent: str | None = None
    """The span of the request that the job came from."""


def create(session: Session, job: Job) -> None:
    """Add a queued job and ask for its wake-up call."""
    moment = clock(session)
    job.created_at = moment
    job.sent_at = moment
    job.sends = 1
    session.add(job)
    session.flush()
    _record_state(session, job)
    wake(session, job.id, job.queue)


def take(session: Session, job_id: str, worker: str, lease: float) -> Claim | None:
    """Take a queued job; None: it is not queued any more."""
    moment = clock(session)
    job = _step(
        session,
        job_id,
        State.RUNNING,
        attempt=Job.attempt + 1,
        lease_owner=worker,
        leased_at=moment,
        lease_until=moment + timedelta(seconds=lease),
        started_at=func.coalesce(Job.started_at, literal(moment, UtcDateTime())),
        progress=None,
    )
    if job is None:
        return None
    session.add(Attempt(job_id=job_id, number=job.attempt, worker=worker, started_at=moment))
    return Claim(
        job_id=job_id,
        tenant_id=job.tenant_id,
        attempt=job.attempt,
        kind=job.kind,
        subject_id=job.subject_id,
        inputs=job.inputs,
        options=job.request["options"],
        rig_id=job.request["rig_id"],
        model_job_id=job.model_job_id,
        frames={chunk.filename: chunk.sha256 for chunk in frames(session, job_id)},
        kept={artifact.name: artifact.sha256 for artifact in _artifacts(session, job_id)},
        deadline_s=job.request.get("deadline_s"),
        traceparent=job.traceparent,
    )


def frames(session: Session, job_id: str) -> Sequence[FrameChunk]:
    """Return the frames of a sequence that are ready, in their order."""
    return session.scalars(
        select(FrameChunk).where(FrameChunk.job_id == job_id).order_by(FrameChunk.first)
    ).all()


def beat(
    session: Session,
    job_id: str,
    attempt: int,
    lease: float,
    *,
    steps: Sequence[dict[str, Any]] = (),
    lines: Sequence[str] = (),
    chunks: Sequence[dict[str, Any]] = (),
    kept: Iterable[Artifact] = (),
) -> State | None:
    """Renew the lease and record what the solver reported and which files it left since the last.

    ``chunks`` are columns of :class:`FrameChunk`: ``first``, ``last``, ``size`` and
    ``sha256``. ``kept`` is half done: nobody is shown it before the job has succeeded.

    Returns ``running`` or ``canceling``; None: the attempt is no longer this worker's.
    """
    moment = clock(session)
    until = moment + timedelta(seconds=lease)
    values: dict[str, Any] = {"leased_at": moment, "lease_until": until}
    reports = [fit_progress(step) for step in steps[-MOST_STEPS_OF_BEAT:]]
    if reports:
        values["progress"] = reports[-1]
    state = session.execute(
        update(Job)
        .where(Job.id == job_id, Job.attempt == attempt, Job.state.in_(HELD))
        .values(**values)
        .returning(Job.state)
    ).scalar_one_or_none()
    if state is None:
        return None
    if reports:
        _record_progress(session, job_id, attempt, reports)
    if lines:
        last = session.scalar(select(func.max(LogLine.number)).where(LogLine.job_id == job_id)) or 0
        for number, line in enumerate(lines, last + 1):
            session.add(LogLine(job_id=job_id, number=number, attempt=attempt, text=line))
    for chunk in chunks:
        # a worker that did not hear that they were written sends them again
        session.merge(FrameChunk(job_id=job_id, attempt=attempt, **chunk))
    _add_artifacts(session, job_id, kept)
    return state


def succeed(
    session: Session,
    job_id: str,
    attempt: int,
    artifacts: Sequence[Artifact],
    *,
    summary: dict[str, Any] | None = None,
    rig: Rig | None = None,
) -> bool:
    """Commit the results of an attempt; False: it is not this worker's to commit."""
    values: dict[str, Any] = {"error": None, "summary": summary}
    if _step(session, job_id, State.SUCCEEDED, Job.attempt == attempt, **values) is None:
        return False
    _add_artifacts(session, job_id, artifacts)
    if rig is not None:
        session.add(rig)
    return True


def _artifacts(session: Session, job_id: str) -> Sequence[Artifact]:
    return session.scalars(select(Artifact).where(Artifact.job_id == job_id)).all()


def _add_artifacts(session: Session, job_id: str, artifacts: Iterable[Artifact]) -> None:
    """Add the files of a job, each in the place of the one of its name that was left before."""
    added = {artifact.name: artifact for artifact in artifacts}
    if added:
        same = (Artifact.job_id == job_id, Artifact.name.in_(added))
        session.execute(delete(Artifact).where(*same))
        session.add_all(added.values())


def fail(session: Session, job_id: str, attempt: int, error: dict[str, Any]) -> bool:
    """Give a job up for good; False: it is not this worker's."""
    return _step(session, job_id, State.FAILED, Job.attempt == attempt, error=error) is not None


def confirm_cancel(session: Session, job_id: str, attempt: int) -> bool:
    """Say that the solver of a job being canceled has stopped."""
    held = (Job.attempt == attempt, Job.state == State.CANCELING)
    return _step(session, job_id, State.CANCELED, *held) is not None


def release(session: Session, job_id: str, attempt: int) -> bool:
    """Give a job back because the worker shuts down; that does not count as a try."""
    held = (Job.attempt == attempt, Job.state == State.RUNNING)
    return _step(session, job_id, State.QUEUED, *held, outcome="released") is not None


def postpone(session: Session, job_id: str, attempt: int, error: dict[str, Any]) -> None:
    """Put a job off because a disk is full; that does not count as a try.

    It waits as long again as it has waited, and fails with ``error`` after an hour.
    """
    moment = clock(session)
    held = (Job.attempt == attempt, Job.state == State.RUNNING)
    since = session.scalar(select(Job.no_room_since).where(Job.id == job_id)) or moment
    if moment - since > WAIT_FOR_ROOM:
        _step(session, job_id, State.FAILED, *held, error=error)
        return
    pause = min(max(moment - since, SHORTEST_WAIT), LONGEST_WAIT)
    waiting = {"not_before": moment + pause, "no_room_since": since}
    _step(session, job_id, State.QUEUED, *held, outcome="postponed", **waiting)


def lose(session: Session, job_id: str, attempt: int, error: dict[str, Any]) -> None:
    """Say that an attempt came to nothing: back to the queue, or failed after the last one."""
    _lose(session, job_id, error, Job.attempt == attempt, Job.state == State.RUNNING)


def cancel(session: Session, job_id: str, by: str, reason: str) -> bool:
    """Ask for a job to stop; a queued one has stopped. False: it is over, or being canceled."""
    session.get(Job, job_id, with_for_update=True)  # else it may change its state between the two
    note = {"by": by, "reason": reason, "requested_at": clock(session).isoformat()}
    return bool(
        _step(session, job_id, State.CANCELED, Job.state == State.QUEUED, cancel=note)
        or _step(session, job_id, State.CANCELING, cancel=note)
    )


def has_run_out(moment: datetime) -> ColumnElement[bool]:
    """Return the condition that a job's lease is over.

    One that was taken or renewed in the future is over, too: the clock has been set back.
    """
    return or_(Job.lease_until < moment, Job.leased_at > moment + LEAST_SETBACK)


def is_due(job: Any, moment: datetime) -> ColumnElement[bool]:
    """Return the condition that a job may be taken: it was not put off, or its time has come.

    ``job`` has its columns. Put off for longer than anybody is means that the clock was set back.
    """
    latest = moment + LONGEST_WAIT
    return or_(job.not_before.is_(None), job.not_before <= moment, job.not_before > latest)


def expire(session: Session, job_id: str, ran_out: ColumnElement[bool]) -> None:
    """Free a job whose lease has run out: back to the queue, given up, or canceled."""
    _step(session, job_id, State.CANCELED, ran_out, Job.state == State.CANCELING, outcome="lost")
    error = {"code": WORKER_LOST, "message": "the worker was lost, at every attempt"}
    _lose(session, job_id, error, ran_out, Job.state == State.RUNNING)


def _lose(
    session: Session, job_id: str, error: dict[str, Any], *conditions: ColumnElement[bool]
) -> None:
    more_tries = Job.lost + 1 < Job.max_attempts
    once_more: dict[str, Any] = {"outcome": "lost", "lost": Job.lost + 1, "no_room_since": None}
    if not _step(session, job_id, State.QUEUED, *conditions, more_tries, **once_more):
        _step(session, job_id, State.FAILED, *conditions, **once_more, error=error)


def _step(
    session: Session,
    job_id: str,
    to: State,
    *conditions: ColumnElement[bool],
    outcome: str | None = None,
    **values: Any,
) -> Job | None:
    """Move a job to ``to`` if the table of transitions and ``conditions`` allow it.

    Leaving a worker's hands closes its attempt with ``outcome`` (default: the new state).
    """
    if to not in HELD:
        values |= {"lease_owner": None, "leased_at": None, "lease_until": None}
        queued = {"sent_at": None, "sends": 0, "not_before": None}
        ended = {"finished_at": clock(session)}
        values = (queued if to is State.QUEUED else ended) | values
    job = session.scalars(
        update(Job)
        .where(Job.id == job_id, Job.state.in_(before(to)), *conditions)
        .values(state=to, **values)
        .returning(Job)
        .execution_options(synchronize_session=False, populate_existing=True)
    ).one_or_none()
    if job is None:
        return None
    if to not in HELD:
        session.execute(
            update(Attempt)
            .where(Attempt.job_id == job_id, Attempt.outcome.is_(None))
            .values(outcome=outcome or to.value, finished_at=clock(session))
        )
        call_waiting(session, job.tenant_id)
    if to in FINAL:
        _thin_progress(session, job_id, MOST_STEPS_KEPT, MOST_STEPS_KEPT)
    _record_state(session, job)
    return job


def _record_progress(
    session: Session, job_id: str, attempt: int, reports: Sequence[dict[str, Any]]
) -> None:
    """Add reports of progress, whose number is bounded however long and much a solver reports."""
    for report in reports:
        session.add(Event(job_id=job_id, kind="progress", data={**report, "attempt": attempt}))
    session.flush()
    _thin_progress(session, job_id, MOST_STEPS, MOST_STEPS // 2)


def _thin_progress(session: Session, job_id: str, most: int, kept: int) -> None:
    """Keep the newest and every n-th before it, of more than ``most`` reports: at most ``kept``."""
    reports = (Event.job_id == job_id, Event.kind == "progress")
    count = session.scalar(select(func.count()).select_from(Event).where(*reports)) or 0
    if count > most:
        every = -(-count // kept)
        number = func.row_number().over(order_by=Event.id.desc()).label("number")
        numbered = select(Event.id, number).where(*reports).subquery()
        superfluous = select(numbered.c.id).where((numbered.c.number - 1) % every != 0)
        session.execute(
            delete(Event)
            .where(Event.id.in_(superfluous))
            .execution_options(synchronize_session=False)
        )


def _record_state(session: Session, job: Job) -> None:
    data: dict[str, Any] = {"state": job.state.value, "attempt": job.attempt}
    if job.error:
        data["error"] = job.error
    session.add(Event(job_id=job.id, kind="state", data=data))
    outbox.notify_of_job(session, job)


def may_run_more(session: Session, tenant_id: str) -> bool:
    """Return whether another job of a tenant may run; for one with a quota, workers ask in turn."""
    tenant = session.get_one(Tenant, tenant_id)
    if not _has_room(session, tenant):
        return False  # without the lock: who goes on to another tenant must hold none
    if tenant.max_running is not None:
        session.refresh(tenant, with_for_update={"key_share": True})
    return _has_room(session, tenant)


def call_waiting(session: Session, tenant_id: str) -> None:
    """Wake a worker of each queue in which a job may have waited for the tenant's quota."""
    if session.get_one(Tenant, tenant_id).max_running is None:
        return
    waiting = select(Job.queue, func.min(Job.id)).where(
        Job.tenant_id == tenant_id, Job.state == State.QUEUED
    )
    for queue, job_id in session.execute(waiting.group_by(Job.queue)).all():
        wake(session, job_id, queue)


def _has_room(session: Session, tenant: Tenant) -> bool:
    if tenant.max_running is None:
        return True
    held = select(func.count(Job.id)).where(Job.tenant_id == tenant.id, Job.state.in_(HELD))
    return (session.scalar(held) or 0) < tenant.max_running
