"""The table of subjects."""

from __future__ import annotations

from sqlalchemy import select
from sqlalchemy.orm import Session

from service import paging
from service.errors import not_found
from service.paging import Slice
from service.store.models import Subject


def get(session: Session, subject_id: str) -> Subject:
    """Return a subject."""
    subject = session.get(Subject, subject_id)
    if subject is None:
        raise not_found("subject", subject_id)
    return subject


def lock(session: Session, subject_id: str) -> Subject:
    """Return a subject that nobody else can change, or give jobs or captures, until the commit."""
    subject = session.get(Subject, subject_id, with_for_update=True)
    if subject is None:
        raise not_found("subject", subject_id)
    return subject


def newest(session: Session, limit: int, cursor: str | None) -> Slice[Subject]:
    """Return subjects, newest first."""
    return paging.newest(session, select(Subject), limit, cursor)
