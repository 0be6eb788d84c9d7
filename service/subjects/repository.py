"""The table of subjects."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

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


def newest(
    session: Session, labels: Sequence[str] | None, limit: int, cursor: str | None
) -> Slice[Subject]:
    """Return subjects, newest first, those with all of ``labels`` if there are any."""
    query = paging.filter_by_labels(select(Subject), Subject.labels, labels)
    return paging.newest(session, query, limit, cursor)


def names(session: Session, subject_ids: Iterable[str]) -> dict[str, str]:
    """Return the names of subjects by their ids."""
    query = select(Subject.id, Subject.name).where(Subject.id.in_(set(subject_ids)))
    return {row.id: row.name for row in session.execute(query)}
