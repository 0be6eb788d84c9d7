"""Which job a worker does next: fair between tenants, then by each tenant's own order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session, aliased

from service.store.database import clock
from service.store.jobs import Claim, expire, take
from service.store.models import Job, Tenant
from service.store.running import may_run_more
from service.store.transitions import HELD, State

MOST_EXPIRED = 100


@dataclass(frozen=True)
class Abilities:
    """What a worker can do: jobs of ``kinds`` that need no more than ``memory_mb`` each."""

    worker: str
    kinds: frozenset[str]
    memory_mb: int
    threads: int


def claim_next(session: Session, queue: str, who: Abilities, lease: float) -> Claim | None:
    """Take the best job of ``queue`` that a worker can do; None: there is none.

    First comes the tenant with the fewest running jobs in the queue, of several the one whose next
    job has waited longest; then the tenant's highest priority; then the oldest. A tenant whose
    quota of running jobs is used up is passed over. Workers that ask in the same moment do not wait
    for one another, but for that quota: each takes what no other is about to.
    """
    moment = clock(session)
    free_expired(session, moment, queue)
    fits = (_waits(queue, moment), Job.kind.in_(who.kinds), _fits(who))
    for tenant_id in _tenants(session, queue, fits):
        if not may_run_more(session, tenant_id):
            continue
        job_id = session.scalar(
            select(Job.id)
            .where(Job.tenant_id == tenant_id, *fits)
            .order_by(*own_order(Job))
            .limit(1)
            .with_for_update(skip_locked=True)
        )
        if job_id is not None:
            return take(session, job_id, who.worker, lease)
    return None


def own_order(job: Any) -> tuple[ColumnElement[Any], ...]:
    """Return the order of a tenant's jobs within a queue; ``job`` has the columns of a job."""
    return job.priority.desc(), job.created_at, job.id


def free_expired(session: Session, moment: datetime, *queues: str) -> None:
    """Take jobs back from workers that have been silent for longer than their lease."""
    held = (Job.queue.in_(queues), Job.state.in_(HELD), Job.lease_until < moment)
    expired = session.scalars(
        select(Job.id)
        .where(*held)
        .order_by(Job.id)
        .limit(MOST_EXPIRED)
        .with_for_update(skip_locked=True)
    ).all()
    for job_id in expired:
        expire(session, job_id, moment)


def _tenants(session: Session, queue: str, fits: Sequence[ColumnElement[bool]]) -> Sequence[str]:
    """Return the tenants with a job to be had, the one whose turn it is first."""
    next_job = (
        select(Job.id)
        .where(Job.tenant_id == Tenant.id, *fits)
        .order_by(*own_order(Job))
        .limit(1)
        .correlate(Tenant)
        .scalar_subquery()
    )
    running = aliased(Job)
    load = (
        select(func.count())
        .where(running.tenant_id == Tenant.id, running.queue == queue, running.state.in_(HELD))
        .correlate(Tenant)
        .scalar_subquery()
    )
    turns = select(
        Tenant.id.label("tenant_id"), next_job.label("job_id"), load.label("load")
    ).subquery()
    waiting = aliased(Job)
    return session.scalars(
        select(turns.c.tenant_id)
        .join(waiting, waiting.id == turns.c.job_id)
        .order_by(turns.c.load, waiting.created_at, waiting.id)
    ).all()


def _waits(queue: str, moment: datetime) -> ColumnElement[bool]:
    due = or_(Job.not_before.is_(None), Job.not_before <= moment)
    return (Job.queue == queue) & (Job.state == State.QUEUED) & due


def _fits(who: Abilities) -> ColumnElement[bool]:
    return or_(Job.memory_mb.is_(None), Job.memory_mb <= who.memory_mb)
