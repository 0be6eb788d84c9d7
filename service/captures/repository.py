"""The table of captures, and the jobs that are about one of them."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from service import paging
from service.errors import unknown
from service.paging import Slice
from service.store.models import Capture, Job
from service.store.transitions import State


def get(session: Session, subject_id: str, capture_id: str) -> Capture:
    """Return a subject's capture."""
    capture = session.get(Capture, capture_id)
    if capture is None or capture.subject_id != subject_id:
        raise unknown("capture", capture_id)
    return capture


def of_subject(session: Session, subject_id: str) -> Sequence[Capture]:
    """Return all of a subject's captures."""
    return session.scalars(select(Capture).where(Capture.subject_id == subject_id)).all()


def newest(session: Session, subject_id: str, limit: int, cursor: str | None) -> Slice[Capture]:
    """Return a subject's captures, newest first."""
    query = select(Capture).where(Capture.subject_id == subject_id)
    return paging.newest(session, query, limit, cursor)


def neutral(session: Session, subject_id: str) -> Capture | None:
    """Return a subject's neutral capture."""
    return session.scalars(
        select(Capture).where(Capture.subject_id == subject_id, Capture.role == "neutral")
    ).one_or_none()


def succeeded_jobs(session: Session, kind: str, capture_ids: Sequence[str]) -> Sequence[Job]:
    """Return the successful jobs of a kind about single captures, newest first."""
    return session.scalars(
        select(Job)
        .where(Job.capture_id.in_(capture_ids), Job.kind == kind, Job.state == State.SUCCEEDED)
        .options(selectinload(Job.artifacts))
        .order_by(Job.created_at.desc(), Job.id.desc())
    ).all()
