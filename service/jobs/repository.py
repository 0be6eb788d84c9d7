"""Queries about jobs; what changes a job's state is in `service.queue.table`."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import ColumnElement, select
from sqlalchemy.orm import Session, selectinload, undefer

from service import paging
from service.errors import not_found
from service.paging import Slice
from service.queue.states import State
from service.store.models import Job, LogLine

IN_SHORT = (selectinload(Job.attempts), selectinload(Job.rig), undefer(Job.last_event_id))
PARTS = (selectinload(Job.artifacts), *IN_SHORT)


def get(session: Session, job_id: str) -> Job:
    """Return a job, as it is in the table now."""
    job = session.get(Job, job_id, options=PARTS, populate_existing=True)
    if job is None:
        raise not_found("job", job_id)
    return job


def newest(
    session: Session, wanted: Sequence[ColumnElement[bool]], limit: int, cursor: str | None
) -> Slice[Job]:
    """Return the jobs that fulfil what is wanted, newest first, without their files."""
    query = select(Job).where(*wanted).options(*IN_SHORT)
    return paging.newest(session, query, limit, cursor)


def newest_model(session: Session, subject_id: str) -> Job | None:
    """Return the subject's newest finished ``build_model`` job."""
    return session.scalars(
        select(Job)
        .where(
            Job.subject_id == subject_id, Job.kind == "build_model", Job.state == State.SUCCEEDED
        )
        .order_by(Job.created_at.desc())
        .limit(1)
    ).one_or_none()


def log(session: Session, job_id: str, after: int, limit: int) -> Sequence[LogLine]:
    """Return lines of a job's log after a line's number."""
    return session.scalars(
        select(LogLine)
        .where(LogLine.job_id == job_id, LogLine.number > after)
        .order_by(LogLine.number)
        .limit(limit)
    ).all()


def log_tail(session: Session, job_id: str, after: int, count: int) -> Sequence[LogLine]:
    """Return the last lines of a job's log, none of them before line ``after``."""
    last = session.scalars(
        select(LogLine)
        .where(LogLine.job_id == job_id, LogLine.number > after)
        .order_by(LogLine.number.desc())
        .limit(count)
    ).all()
    return last[::-1]
