"""Deleting: rows at once, with a receipt that says when the last file was gone, too.

The sweeper removes the files. Those whose bytes something else has, too, stay for that.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from datetime import datetime, timedelta
from itertools import islice
from typing import Literal

from sqlalchemy import ColumnElement, Text, and_, cast, delete, or_, select, update
from sqlalchemy.orm import Session, aliased

from service.queue.states import FINAL
from service.queue.table import cancel
from service.store.database import Store, clock
from service.store.files import Files, StoredFile
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
    is_preview_of,
    now,
)

Reason = Literal["request", "retention"]
BY = "deletion"
BATCH = 200
# Jobs that a receipt names, of those that had read files of what was deleted
MOST_READERS = 20
# Seconds between two rounds of the sweeper's that collect garbage, at most
COLLECT_EVERY = 60.0

# The columns that keep a file
REFERRING = (
    Artifact.sha256,
    Capture.sha256,
    Capture.landmarks_sha256,
    Capture.mask_sha256,
    FrameChunk.sha256,
    Template.sha256,
    Upload.sha256,
)


def active_jobs(session: Session, subject_id: str) -> Sequence[str]:
    """Return the ids of a subject's jobs that are not over."""
    return session.scalars(
        select(Job.id).where(Job.subject_id == subject_id, Job.state.not_in(FINAL))
    ).all()


def is_read_by(source: str) -> ColumnElement[bool]:
    """Select the jobs that read a file of ``source``: of a capture, or of a job that left it."""
    other = aliased(Job)
    of_capture = select(Capture.subject_id).where(Capture.id == source)
    of_job = select(other.subject_id).where(other.id == source)
    # the subject's jobs alone are looked through, by an index
    return and_(or_(Job.subject_id.in_(of_capture), Job.subject_id.in_(of_job)), _names(source))


def _names(source: str) -> ColumnElement[bool]:
    """Select the jobs whose inputs name a capture or job; all jobs there are are looked through."""
    # no name has a quote that is not escaped, and so none looks like this
    return cast(Job.inputs, Text).contains(f'"of": "{source}"', autoescape=True)


def _readers(session: Session, subject_id: str, sources: Iterable[str]) -> list[str]:
    """Return the newest jobs of a subject that had read files of what goes, and stay."""
    gone = set(sources)
    jobs = select(Job.id, Job.inputs).where(Job.subject_id == subject_id)
    readers = (
        job
        for job, inputs in session.execute(jobs.order_by(Job.created_at.desc()))
        if job not in gone and any(each.get("of") in gone for each in inputs)
    )
    return [*islice(readers, MOST_READERS)]


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
    known = waiting_receipt(session, subject.id)
    return known or _receipt(session, subject, "subject", reason)


def waiting_receipt(session: Session, subject_id: str) -> Deletion | None:
    """Return the receipt of a subject that is deleted when its jobs have ended, if it is."""
    waiting = select(Deletion).where(Deletion.object_id == subject_id, Deletion.rows_at.is_(None))
    return session.scalars(waiting).first()


def delete_capture(session: Session, capture: Capture, reason: Reason) -> Deletion:
    """Delete a scan with its checks and registrations."""
    receipt = _receipt(session, capture, "capture", reason)
    about = session.scalars(select(Job.id).where(Job.capture_id == capture.id)).all()
    receipt.read_by = _readers(session, capture.subject_id, [capture.id, *about])
    files = [
        *capture.uploaded_files,
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
    gone = (Job.id == job.id) if rig is None else (Job.id == job.id) | is_preview_of(rig)
    jobs = session.scalars(select(Job.id).where(gone)).all()
    receipt.read_by = _readers(session, job.subject_id, jobs)
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


def close_receipts(store: Store, age: float) -> None:
    """Note which deletions have no file left: after files were removed, not more often.

    ``age`` is that of `collect_garbage`. A receipt stays open for as long as a file of one owner
    takes to go: one that closed sooner would tell that somebody else has the same file.
    """
    with store.read() as session:
        last = clock(session) - timedelta(seconds=2 * age + 2 * min(age, COLLECT_EVERY))
        opened = select(Deletion).where(Deletion.rows_at <= last, Deletion.files_at.is_(None))
        receipts = session.scalars(opened.order_by(Deletion.created_at).limit(BATCH)).all()
    if not receipts:
        return
    wanted = referenced_files(store)
    aside = {stored.sha256 for stored in store.files.list_aside()}
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
        *(sha256 for capture in captures for sha256 in capture.uploaded_files),
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
    receipt.files = sorted(set(files))
    receipt.rows_at = clock(session)
    if not receipt.files:
        receipt.files_at = receipt.rows_at
    session.flush()


def collect_garbage(store: Store, age: float) -> int:
    """Remove files that no row refers to and that are older than ``age`` seconds.

    In two steps, each with a look into the tables of its own: such a file is put aside, and goes
    ``age`` seconds later if still nothing refers to it. So the row of what is stored must be
    committed within ``age`` seconds. Returns how many went.
    """
    limit = now() - timedelta(seconds=age)
    store.files.remove_unfinished(limit)
    # Listed before the tables are read: what is stored in between is not in the lists.
    aside = _older(store.files.list_aside(), limit)
    stored = _older(store.files.list_stored(), limit)
    wanted = referenced_files(store)
    removed = sum(_decide(store.files, sha256, sha256 in wanted) for sha256 in aside)
    for sha256 in stored:
        if sha256 not in wanted:
            with suppress(FileNotFoundError):  # another sweeper was faster
                store.files.put_aside(sha256)
    return removed


def referenced_files(store: Store) -> set[str]:
    """Return the sha256 of the files that rows refer to, and that jobs still read."""
    with store.read() as session:
        return references(session)


def references(session: Session) -> set[str]:
    """Return the sha256 of the files that the rows of a session refer to."""
    found: set[str] = set()
    for column in REFERRING:
        found.update(filter(None, session.scalars(select(column).distinct())))
    active = select(Job.inputs).where(Job.state.not_in(FINAL))
    for inputs in session.scalars(active):
        found.update(item["sha256"] for item in inputs)
    return found


def _older(files: Iterator[StoredFile], limit: datetime) -> list[str]:
    return [stored.sha256 for stored in files if stored.at < limit]


def _decide(files: Files, sha256: str, wanted: bool) -> bool:
    """Take back or remove a file that was put aside; returns whether it is gone."""
    with suppress(FileNotFoundError):
        if wanted:
            files.take_back(sha256)
        else:
            files.remove(sha256)
    return not wanted
