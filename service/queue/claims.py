"""Choose the job that a worker does next: fair between tenants, then by each tenant's own order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session, aliased

from service.queue.states import HELD, State
from service.queue.table import Claim, expire, has_run_out, is_due, may_run_more, take
from service.store.database import clock
from service.store.models import Job, Tenant

MOST_EXPIRED = 100

# Places count the jobs of all tenants, so these queries go round the tenant's view of `Job`
JOBS = Job.__table__.c


@dataclass(frozen=True)
class Abilities:
    """Abilities of a worker: jobs of ``kinds`` that need no more than ``memory_mb`` each."""

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
    free_expired(session, lease, queue)
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


def free_expired(session: Session, lease: float, *queues: str) -> None:
    """Take jobs back from workers that have been silent for longer than their lease."""
    ran_out = has_run_out(clock(session), lease)
    held = (Job.queue.in_(queues), Job.state.in_(HELD), ran_out)
    expired = session.scalars(
        select(Job.id)
        .where(*held)
        .order_by(Job.id)
        .limit(MOST_EXPIRED)
        .with_for_update(skip_locked=True)
    ).all()
    for job_id in expired:
        expire(session, job_id, ran_out)


def _tenants(session: Session, queue: str, fits: Sequence[ColumnElement[bool]]) -> Sequence[str]:
    """Return tenants with a runnable job, in fair-share order."""
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
    return (Job.queue == queue) & (Job.state == State.QUEUED) & is_due(Job, moment)


def _fits(who: Abilities) -> ColumnElement[bool]:
    return or_(Job.memory_mb.is_(None), Job.memory_mb <= who.memory_mb)


def positions(session: Session, jobs: Sequence[Job]) -> dict[str, int]:
    """Return the places of those of ``jobs`` that wait for a worker, 1 for the next.

    A tenant's turns alternate with those of the others, and one with running jobs waits for as many
    turns more. A job that was put off has no place until its time has come.
    """
    wanted = [job.id for job in jobs if job.state is State.QUEUED]
    if not wanted:
        return {}
    queues = {job.queue for job in jobs if job.state is State.QUEUED}
    running = (
        select(JOBS.queue, JOBS.tenant_id, func.count().label("load"))
        .where(JOBS.queue.in_(queues), JOBS.state.in_(HELD))
        .group_by(JOBS.queue, JOBS.tenant_id)
        .subquery()
    )
    due = or_(JOBS.not_before.is_(None), JOBS.not_before <= clock(session))
    rank = func.row_number().over(
        partition_by=(JOBS.queue, JOBS.tenant_id), order_by=own_order(JOBS)
    )
    waiting = (
        select(JOBS.id, JOBS.queue, JOBS.tenant_id, JOBS.created_at, rank.label("rank"))
        .where(JOBS.queue.in_(queues), JOBS.state == State.QUEUED, due)
        .subquery()
    )
    turn = waiting.c.rank + func.coalesce(running.c.load, 0)
    place = func.row_number().over(
        partition_by=waiting.c.queue, order_by=(turn, waiting.c.created_at, waiting.c.id)
    )
    same = (running.c.queue == waiting.c.queue) & (running.c.tenant_id == waiting.c.tenant_id)
    places = select(waiting.c.id, place.label("place")).outerjoin(running, same).subquery()
    rows = session.execute(select(places.c.id, places.c.place).where(places.c.id.in_(wanted)))
    return {row.id: row.place for row in rows}
