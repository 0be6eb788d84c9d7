"""What can be done with subjects."""

from __future__ import annotations

from sqlalchemy import delete as delete_rows
from sqlalchemy import select
from sqlalchemy.orm import Session

from service.errors import Problem
from service.store.models import Capture, Subject, Upload
from service.subjects import repository
from service.subjects.schemas import NewSubject
from service.templates import repository as templates


def create(session: Session, new: NewSubject) -> Subject:
    """Add a subject."""
    if new.template_id is not None:
        templates.get(session, new.template_id)
    subject = Subject(name=new.name, template_id=new.template_id)
    session.add(subject)
    session.flush()
    return subject


def refuse_while_busy(session: Session, subject_id: str) -> None:
    """Raise a problem while jobs read the subject's files."""
    if jobs := repository.active_jobs(session, subject_id):
        raise Problem(
            409,
            "subject.busy",
            "the subject has jobs that are not over; cancel them first",
            subject_id=subject_id,
            job_ids=list(jobs),
        )


def delete(session: Session, subject_id: str) -> None:
    """Delete a subject with all that is its own; the sweeper removes the files.

    The uploads of its scans go too: they would keep the files until they expire.
    """
    subject = repository.get(session, subject_id)
    refuse_while_busy(session, subject_id)
    scans = select(Capture.sha256).where(Capture.subject_id == subject_id)
    session.execute(delete_rows(Upload).where(Upload.complete, Upload.sha256.in_(scans)))
    session.delete(subject)
