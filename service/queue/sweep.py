"""Repairs of the sweeper: lost messages, lost workers, abandoned uploads, sizes never written."""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy import delete, insert, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.queue.claims import free_expired
from service.queue.states import State
from service.queue.table import is_due
from service.queue.wakeups import QUEUES, wake
from service.store.database import Store, clock
from service.store.files import Files
from service.store.models import Capture, FrameChunk, Job, Lease, Upload, Worker

LONGEST_PAUSE = timedelta(minutes=1)
FORGET_WORKERS = timedelta(minutes=10)
MOST_SENT = 250  # of a queue in a round: a message only says that there is something
# Office of the worker that sweeps
SWEEPER = "sweeper"

# An office ends at most so many of one's own terms ahead: another host's may be longer
MOST_OFFICE_TERMS = 2

MOST_FILES = 200
UNMEASURED = (
    (Capture.landmarks_sha256, Capture.landmarks_size),
    (FrameChunk.sha256, FrameChunk.size),
)


def hold_office(session: Session, office: str, holder: str, seconds: float) -> bool:
    """Take or keep an office that one process holds at a time; False: somebody else has it.

    One that is held for longer than anybody takes it is free: the clock has been set back.
    """
    moment = clock(session)
    until = moment + timedelta(seconds=seconds)
    too_late = moment + MOST_OFFICE_TERMS * timedelta(seconds=seconds)
    mine_or_free = (Lease.holder == holder) | (Lease.until < moment) | (Lease.until > too_late)
    taken = session.execute(
        update(Lease)
        .where(Lease.office == office, mine_or_free)
        .values(holder=holder, until=until)
        .returning(Lease.office)
    ).scalar_one_or_none()
    if taken is None and session.get(Lease, office) is None:
        try:
            with session.begin_nested():
                session.execute(insert(Lease).values(office=office, holder=holder, until=until))
        except IntegrityError:
            return False  # somebody else was faster
        return True
    return taken is not None


def expire_leases(session: Session) -> None:
    """Take jobs of every queue back from workers that have been silent for longer than a lease."""
    free_expired(session, *QUEUES)


def resend(session: Session, after: float, *, at_once: bool = False) -> None:
    """Send again what is queued and was not picked up, with doubling pauses from ``after`` seconds.

    ``at_once`` ignores the pauses: a worker that starts may have missed everything.
    """
    moment = clock(session)
    for queue in QUEUES:  # a long one does not keep another from being served
        waits = (Job.queue == queue, Job.state == State.QUEUED, is_due(Job, moment))
        queued = select(Job).where(*waits).order_by(Job.created_at).limit(MOST_SENT)
        for job in session.scalars(queued):
            if at_once or _should_resend(job, moment, after):
                job.sends = job.sends + 1
                job.sent_at = moment
                wake(session, job.id, job.queue)


def _should_resend(job: Job, moment: datetime, after: float) -> bool:
    if job.sent_at is None or job.sent_at > moment:  # the clock has been set back
        return True
    pause = min(timedelta(seconds=after) * 2 ** min(job.sends - 1, 20), LONGEST_PAUSE)
    due: bool = job.sent_at + pause <= moment
    return due


def remove_expired_uploads(session: Session) -> None:
    """Forget uploads past their date; captures made from them keep their file.

    Bytes of unfinished ones are the API's to remove: this host may not have its folder.
    """
    session.execute(delete(Upload).where(Upload.expires_at < clock(session)))


def forget_workers(session: Session) -> None:
    """Forget workers that have not been seen for a while."""
    session.execute(delete(Worker).where(Worker.seen_at < clock(session) - FORGET_WORKERS))


def measure_sizes(store: Store) -> None:
    """Backfill file sizes for rows written before quotas existed; a file that is lost has 0.

    A worker that is not upgraded yet goes on leaving some.
    """
    for sha256, size in UNMEASURED:
        with store.read() as session:
            unknown = select(sha256).where(sha256.is_not(None), size.is_(None))
            files = session.scalars(unknown.distinct().limit(MOST_FILES)).all()
        for file in filter(None, files):
            found = _size(store.files, file)
            with store.write() as session:
                session.execute(
                    update(sha256.class_)
                    .where(sha256 == file, size.is_(None))
                    .values({size.key: found})
                )


def _size(files: Files, sha256: str) -> int:
    try:
        return files.size(sha256)
    except FileNotFoundError:
        return 0
