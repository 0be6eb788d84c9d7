"""Subject operations: create, delete."""

from __future__ import annotations

from sqlalchemy.orm import Session

from service.errors import Problem
from service.store.deletion import active_jobs, delete_subject, delete_subject_later
from service.store.models import Deletion, Subject
from service.subjects import repository
from service.subjects.schemas import NewSubject
from service.templates import repository as templates


def create(session: Session, new: NewSubject) -> Subject:
    """Add a subject."""
    if new.template_id is not None:
        templates.hold(session, new.template_id)
    subject = Subject(name=new.name, template_id=new.template_id)
    session.add(subject)
    session.flush()
    return subject


def refuse_while_busy(session: Session, subject_id: str) -> None:
    """Raise a problem while jobs read the subject's files."""
    if jobs := active_jobs(session, subject_id):
        raise Problem(
            409,
            "subject.busy",
            "the subject has jobs that are not over; cancel them first",
            subject_id=subject_id,
            job_ids=list(jobs),
        )


def delete(session: Session, subject_id: str, *, cancel: bool) -> Deletion:
    """Delete a subject with all that is its own; ``cancel`` stops its jobs first."""
    subject = repository.lock(session, subject_id)
    if cancel:
        return delete_subject_later(session, subject)
    refuse_while_busy(session, subject_id)
    return delete_subject(session, subject, "request")
