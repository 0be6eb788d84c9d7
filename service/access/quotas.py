"""How much of the service a tenant may use; its row holds the limits, null is none."""

from __future__ import annotations

from sqlalchemy import func, select, union
from sqlalchemy.orm import Session

from service.errors import Problem
from service.store.models import Artifact, Capture, FrameChunk, Job, Template, Upload
from service.store.tenancy import own_tenant
from service.store.transitions import HELD, State

ASK_AGAIN = "60"


def check_bytes(session: Session, size: int) -> None:
    """Make room for a file of ``size`` bytes; two at a time wait for one another.

    Raises
    ------
    Problem
        413 for a file that does not fit, alone or beside what is stored: waiting makes no room.
    """
    tenant = own_tenant(session, lock=True)
    if tenant.max_bytes is None:
        return
    most = tenant.max_bytes
    if size > most:
        raise Problem(
            413, "quota.bytes", "the file is larger than the quota", expected=most, found=size
        )
    used = stored_bytes(session, tenant.id)
    if used + size > most:
        raise Problem(
            413,
            "quota.bytes",
            f"{used} of {most} bytes are in use: delete something first",
            expected=most,
            found=used + size,
        )


def check_queued(session: Session) -> None:
    """Make room for a job in the queue.

    Raises
    ------
    Problem
        429 if as many jobs wait as the tenant may have.
    """
    tenant = own_tenant(session, lock=True)
    if tenant.max_queued is None:
        return
    waiting = queued(session)
    if waiting >= tenant.max_queued:
        problem = Problem(
            429,
            "quota.queued",
            f"{waiting} jobs wait already: let some end first",
            expected=tenant.max_queued,
            found=waiting,
        )
        problem.headers = {"Retry-After": ASK_AGAIN}
        raise problem


def stored_bytes(session: Session, tenant_id: str) -> int:
    """Return the bytes of a tenant's files, each counted once, and of its open uploads."""
    tables = (Capture, Template, Artifact)
    files = (
        select(table.sha256, table.size).where(table.tenant_id == tenant_id) for table in tables
    )
    sent = select(Upload.sha256, Upload.size).where(Upload.tenant_id == tenant_id, Upload.complete)
    landmarks = select(Capture.landmarks_sha256, Capture.landmarks_size).where(
        Capture.tenant_id == tenant_id
    )
    frames = select(FrameChunk.sha256, FrameChunk.size).join(Job, Job.id == FrameChunk.job_id)
    frames = frames.where(Job.tenant_id == tenant_id)
    counted = union(sent, landmarks, frames, *files).subquery()
    stored = session.scalar(select(func.sum(counted.c.size)))
    opened = session.scalar(
        select(func.sum(Upload.size)).where(Upload.tenant_id == tenant_id, ~Upload.complete)
    )
    return int(stored or 0) + int(opened or 0)


def queued(session: Session) -> int:
    """Return how many of the tenant's jobs wait."""
    return session.scalar(select(func.count(Job.id)).where(Job.state == State.QUEUED)) or 0


def running(session: Session) -> int:
    """Return how many of the tenant's jobs a worker has."""
    return session.scalar(select(func.count(Job.id)).where(Job.state.in_(HELD))) or 0
