"""Queries about jobs; what changes a job's state is in `service.store.jobs`."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import func, select
from sqlalchemy.orm import Session, selectinload, undefer

from service import paging
from service.errors import unknown
from service.paging import Slice
from service.store.models import Event, Job, LogLine
from service.store.transitions import State

PARTS = (
    selectinload(Job.attempts),
    selectinload(Job.artifacts),
    selectinload(Job.rig),
    undefer(Job.last_event_id),
)


def get(session: Session, job_id: str) -> Job:
    """Return a job, as it is in the table now."""
    job = session.get(Job, job_id, options=PARTS, populate_existing=True)
    if job is None:
        raise unknown("job", job_id)
    return job


def newest(
    session: Session,
    *,
    subject_id: str | None,
    capture_id: str | None,
    state: State | None,
    kind: str | None,
    limit: int,
    cursor: str | None,
) -> Slice[Job]:
    """Return jobs, newest first."""
    wanted = {
        Job.subject_id: subject_id,
        Job.capture_id: capture_id,
        Job.state: state,
        Job.kind: kind,
    }
    conditions = [column == value for column, value in wanted.items() if value is not None]
    query = select(Job).where(*conditions).options(*PARTS)
    return paging.newest(session, query, limit, cursor)


def newest_model(session: Session, subject_id: str) -> Job | None:
    """Return the subject's newest finished ``build_model`` job."""
    return session.scalars(
        select(Job)
        .where(
            Job.subject_id == subject_id,
            Job.kind == "build_model",
            Job.state == State.SUCCEEDED,
        )
        .order_by(Job.created_at.desc())
        .limit(1)
    ).one_or_none()


def queue_position(session: Session, job: Job) -> int | None:
    """Return a queued job's place, 1 for the next."""
    if job.state is not State.QUEUED:
        return None
    ahead = select(func.count()).where(
        Job.state == State.QUEUED, Job.queue == job.queue, Job.created_at < job.created_at
    )
    return 1 + (session.scalar(ahead) or 0)


def events(session: Session, job_id: str, after: int) -> Sequence[Event]:
    """Return a job's events after an event's id."""
    return session.scalars(
        select(Event).where(Event.job_id == job_id, Event.id > after).order_by(Event.id).limit(500)
    ).all()


def log(session: Session, job_id: str, after: int, limit: int) -> Sequence[LogLine]:
    """Return lines of a job's log after a line's number."""
    return session.scalars(
        select(LogLine)
        .where(LogLine.job_id == job_id, LogLine.number > after)
        .order_by(LogLine.number)
        .limit(limit)
    ).all()
