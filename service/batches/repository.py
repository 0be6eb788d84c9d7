"""Queries about batches."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from service import paging
from service.errors import unknown
from service.paging import Slice
from service.store.models import Batch, Capture, Job

AT_ONCE = 10_000
"""Ids in a statement: PostgreSQL takes 65,535 parameters, SQLite 32,766."""


def get(session: Session, batch_id: str) -> Batch:
    """Return a batch."""
    batch = session.get(Batch, batch_id)
    if batch is None:
        raise unknown("batch", batch_id)
    return batch


def lock(session: Session, batch_id: str) -> Batch:
    """Return a batch that nobody else can change until the commit."""
    batch = session.get(Batch, batch_id, with_for_update=True, populate_existing=True)
    if batch is None:
        raise unknown("batch", batch_id)
    return batch


def newest(
    session: Session, subject_id: str | None, state: str | None, limit: int, cursor: str | None
) -> Slice[Batch]:
    """Return batches, newest first."""
    query = select(Batch)
    if subject_id is not None:
        query = query.where(Batch.subject_id == subject_id)
    if state is not None:
        query = query.where(Batch.state == state)
    return paging.newest(session, query, limit, cursor)


def running(session: Session) -> Sequence[tuple[str, str]]:
    """Return the tenant and the id of each batch that goes on."""
    rows = session.execute(
        select(Batch.tenant_id, Batch.id)
        .where(Batch.state == "running")
        .order_by(Batch.created_at, Batch.id)
    )
    return [(tenant_id, batch_id) for tenant_id, batch_id in rows]


def jobs(session: Session, batch_ids: Sequence[str]) -> Sequence[Job]:
    """Return the jobs of batches, oldest first."""
    return session.scalars(
        select(Job)
        .where(Job.batch_id.in_(batch_ids))
        .options(selectinload(Job.rig))
        .order_by(Job.created_at, Job.id)
        .execution_options(populate_existing=True)
    ).all()


def captures(session: Session, capture_ids: Sequence[str]) -> dict[str, Capture]:
    """Return captures by their ids; those that were deleted are not among them."""
    found: dict[str, Capture] = {}
    for start in range(0, len(capture_ids), AT_ONCE):
        ids = capture_ids[start : start + AT_ONCE]
        there = session.scalars(select(Capture).where(Capture.id.in_(ids)))
        found |= {capture.id: capture for capture in there}
    return found
