"""Deleting: rows at once, with a receipt that says when the last file was gone, too.

The sweeper removes the files. Those whose bytes something else has, too, stay for that.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal

from sqlalchemy import ColumnElement, delete, select, update
from sqlalchemy.orm import Session

from service.store import previews
from service.store.database import clock
from service.store.garbage import referenced_files
from service.store.jobs import cancel
from service.store.models import (
    Artifact,
    Capture,
    Deletion,
    FrameChunk,
    Job,
    Rig,
    Subject,
    Template,
    Upload,
)
from service.store.store import Store
from service.store.transitions import FINAL

Reason = Literal["request", "retention"]
BY = "deletion"
BATCH = 200


def active_jobs(session: Session, subject_id: str) -> Sequence[str]:
    """Return the ids of a subject's jobs that are not over."""
    return session.scalars(
        select(Job.id).where(Job.subject_id == subject_id, Job.state.not_in(FINAL))
    ).all()


def delete_subject(session: Session, subject: Subject, reason: Reason) -> Deletion:
    """Delete a subject with all that is its own."""
    receipt = _receipt_of(session, subject, reason)
    _delete_subject(session, subject, receipt)
    return receipt


def delete_subject_later(session: Session, subject: Subject) -> Deletion:
    """Stop a subject's jobs; it is deleted when the last of them has ended."""
    receipt = _receipt_of(session, subject, "request")
    _stop_jobs(session, subject.id)
    if not active_jobs(session, subject.id):  # all were waiting
        _delete_subject(session, subject, receipt)
    return receipt


def _receipt_of(session: Session, subject: Subject, reason: Reason) -> Deletion:
    """Return the receipt of a subject that waits for its jobs to end, or a new one.

    A second one would be closed at once, with files still there.
    """
    waiting = select(Deletion).where(Deletion.object_id == subject.id, Deletion.rows_at.is_(None))
    return session.scalars(waiting).first() or _receipt(session, subject, "subject", reason)


def delete_capture(session: Session, capture: Capture, reason: Reason) -> Deletion:
    """Delete a scan with its checks and registrations."""
    receipt = _receipt(session, capture, "capture", reason)
    files = [
        *capture.uploaded,
        *_forget_uploads(session, Upload.used_by == capture.id),
        *_left_by(session, Job.capture_id == capture.id),
    ]
    session.execute(delete(Job).where(Job.capture_id == capture.id))
    session.delete(capture)
    _sign(session, receipt, files)
    return receipt


def delete_job(session: Session, job: Job, reason: Reason) -> Deletion:
    """Delete a job with what it left, its rig too, and that one's preview."""
    rig = session.scalars(select(Rig.id).where(Rig.job_id == job.id)).one_or_none()
    receipt = _receipt(session, job, "rig" if rig else "job", reason)
    receipt.object_id = rig or job.id
    gone = (Job.id == job.id) if rig is None else (Job.id == job.id) | previews.of_rig(rig)
    files = _left_by(session, gone)
    session.execute(delete(Job).where(gone))
    _sign(session, receipt, files)
    return receipt


def delete_template(session: Session, template: Template, reason: Reason) -> Deletion:
    """Delete a template that no subject has."""
    receipt = _receipt(session, template, "template", reason)
    files = [template.sha256, *_forget_uploads(session, Upload.used_by == template.id)]
    session.delete(template)
    _sign(session, receipt, files)
    return receipt


def go_on(session: Session) -> None:
    """Delete the subjects that were waiting for their jobs to end."""
    waiting = select(Deletion).where(Deletion.rows_at.is_(None)).limit(BATCH)
    for receipt in session.scalars(waiting).all():
        subject = session.get(Subject, receipt.object_id, with_for_update=True)
        if subject is None:  # deleted by another request meanwhile
            _sign(session, receipt, [])
        elif active_jobs(session, subject.id):
            _stop_jobs(session, subject.id)
        else:
            _delete_subject(session, subject, receipt)


def close_receipts(store: Store) -> None:
    """Note which deletions have no file left: after files were removed, not more often."""
    opened = select(Deletion).where(Deletion.rows_at.is_not(None), Deletion.files_at.is_(None))
    with store.read() as session:
        receipts = session.scalars(opened.order_by(Deletion.created_at).limit(BATCH)).all()
    if not receipts:
        return
    wanted = referenced_files(store)
    aside = {stored.sha256 for stored in store.files.aside()}
    closed = [
        receipt.id
        for receipt in receipts
        if not any(
            sha256 in aside or store.files.exists(sha256)
            for sha256 in receipt.files
            if sha256 not in wanted
        )
    ]
    with store.write() as session:
        values = {"files": [], "files_at": clock(session)}
        session.execute(update(Deletion).where(Deletion.id.in_(closed)).values(**values))


def _delete_subject(session: Session, subject: Subject, receipt: Deletion) -> None:
    captures = session.scalars(select(Capture).where(Capture.subject_id == subject.id)).all()
    ids = select(Capture.id).where(Capture.subject_id == subject.id)
    files = [
        *(sha256 for capture in captures for sha256 in capture.uploaded),
        *_forget_uploads(session, Upload.used_by.in_(ids)),
        *_left_by(session, Job.subject_id == subject.id),
    ]
    session.delete(subject)
    _sign(session, receipt, files)


def _stop_jobs(session: Session, subject_id: str) -> None:
    for job_id in active_jobs(session, subject_id):
        cancel(session, job_id, BY, "its subject is deleted")


def _left_by(session: Session, which: ColumnElement[bool]) -> Iterable[str]:
    """Return the files that jobs left."""
    for table in (Artifact, FrameChunk):
        of_jobs = select(table.sha256).join(Job, Job.id == table.job_id).where(which)
        yield from session.scalars(of_jobs.distinct())


def _forget_uploads(session: Session, which: ColumnElement[bool]) -> Iterable[str]:
    """Delete the uploads of what is deleted, those it was given once, too; return their files."""
    gone = session.scalars(delete(Upload).where(which).returning(Upload.sha256)).all()
    return filter(None, gone)


def _receipt(
    session: Session, what: Subject | Capture | Job | Template, kind: str, reason: Reason
) -> Deletion:
    receipt = Deletion(
        tenant_id=what.tenant_id,
        kind=kind,
        object_id=what.id,
        reason=reason,
        files=[],
        created_at=clock(session),
    )
    session.add(receipt)
    session.flush()
    return receipt


def _sign(session: Session, receipt: Deletion, files: Iterable[str]) -> None:
    receipt.files, receipt.rows_at = sorted(set(files)), clock(session)
    if not receipt.files:
        receipt.files_at = receipt.rows_at
    session.flush()
