"""Subject operations: create, change, delete; and the labels of what is a subject's."""

from __future__ import annotations

from collections.abc import Mapping

from sqlalchemy.orm import Session

from service.errors import Problem
from service.schemas import MOST_LABELS
from service.store.deletion import active_jobs, delete_subject, delete_subject_later
from service.store.models import Deletion, Labelled, Subject
from service.subjects import repository
from service.subjects.schemas import NewSubject, SubjectChange
from service.templates import repository as templates


def create(session: Session, new: NewSubject) -> Subject:
    """Add a subject."""
    if new.template_id is not None:
        templates.hold(session, new.template_id)
    subject = Subject(name=new.name, template_id=new.template_id, labels=new.labels)
    session.add(subject)
    session.flush()
    return subject


def change(session: Session, subject_id: str, order: SubjectChange) -> Subject:
    """Change a subject's name or labels."""
    subject = repository.lock(session, subject_id)
    subject.name = order.name or subject.name
    relabel(subject, order.labels)
    return subject


def relabel(row: Labelled, changes: Mapping[str, str | None] | None) -> None:
    """Set the labels that have a value and take away those that are null; others stay."""
    merged = {**row.labels, **(changes or {})}
    labels = {key: value for key, value in merged.items() if value is not None}
    if len(labels) > MOST_LABELS:
        detail = f"there would be {len(labels)} labels, and {MOST_LABELS} is the most"
        raise Problem(422, "labels.too_many", detail, expected=MOST_LABELS, found=len(labels))
    row.labels = labels


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
