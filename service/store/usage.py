"""Measure what a tenant has stored, beside what it may store."""

from __future__ import annotations

from sqlalchemy import func, select, union
from sqlalchemy.orm import Session

from service.store.models import Artifact, Capture, FrameChunk, Job, Template, Tenant, Upload


def stored_bytes(session: Session, tenant_id: str) -> int:
    """Return the bytes of a tenant's files, each counted once, and of its open uploads."""
    tables = (Capture, Template, Artifact)
    files = (
        select(table.sha256, table.size).where(table.tenant_id == tenant_id) for table in tables
    )
    sent = select(Upload.sha256, Upload.size).where(Upload.tenant_id == tenant_id, Upload.complete)
    beside = (
        select(sha256, size).where(Capture.tenant_id == tenant_id)
        for sha256, size in (
            (Capture.landmarks_sha256, Capture.landmarks_size),
            (Capture.mask_sha256, Capture.mask_size),
        )
    )
    frames = select(FrameChunk.sha256, FrameChunk.size).join(Job, Job.id == FrameChunk.job_id)
    frames = frames.where(Job.tenant_id == tenant_id)
    counted = union(sent, frames, *beside, *files).subquery()
    stored = session.scalar(select(func.sum(counted.c.size)))
    opened = session.scalar(
        select(func.sum(Upload.size)).where(Upload.tenant_id == tenant_id, ~Upload.complete)
    )
    return int(stored or 0) + int(opened or 0)


def free_bytes(session: Session, tenant_id: str) -> int | None:
    """Return the bytes that a tenant may still store; None: it has no quota."""
    most = session.get_one(Tenant, tenant_id).max_bytes
    return None if most is None else max(most - stored_bytes(session, tenant_id), 0)
