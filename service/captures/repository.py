"""The table of captures."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.errors import unknown
from service.store.models import Capture


def get(session: Session, subject_id: str, capture_id: str) -> Capture:
    """Return a subject's capture."""
    capture = session.get(Capture, capture_id)
    if capture is None or capture.subject_id != subject_id:
        raise unknown("capture", capture_id)
    return capture


def of_subject(session: Session, subject_id: str) -> Sequence[Capture]:
    """Return a subject's captures, newest first."""
    return session.scalars(
        select(Capture)
        .where(Capture.subject_id == subject_id)
        .order_by(Capture.created_at.desc(), Capture.name)
    ).all()


def neutral(session: Session, subject_id: str) -> Capture | None:
    """Return a subject's neutral capture."""
    return session.scalars(
        select(Capture).where(Capture.subject_id == subject_id, Capture.role == "neutral")
    ).one_or_none()
