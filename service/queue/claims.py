"""Choose the job that a worker does next: fair between tenants, then by each tenant's own order."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, func, or_, select
from sqlalchemy.orm import Session, aliased

from service.queue.states import HELD, State
from service.queue.table import Claim, expire, has_run_out, is_due, may_run_more, take
from service.store.database import clock, one_at_a_time
from service.store.models import ApiKey, Job, Tenant, Worker

MOST_EXPIRED = 100
# Seconds in which a living worker is seen, unless its settings say otherwise
TERM = 15.0
# Jobs of a tenant that have a place in the queue
MOST_TURNS = 1000
# Since a tenant's last request, in which it may soon have a job: a worker is kept free for it
PRESENT = timedelta(minutes=10)
# Scope of the keys that submit jobs
SUBMITS = "write"

# Places count the jobs of all tenants, so these queries go round the tenant's view of `Job`
JOBS = Job.__table__.c
KEYS = ApiKey.__table__.c


@dataclass(frozen=True)
class Abilities:
    """Abilities of a worker: jobs of ``kinds`` that need no more than ``memory_mb`` each."""

    worker: str
    kinds: frozenset[str]
    memory_mb: int
    threads: int


def claim_next(
    session: Session, queue: str, who: Abilities, lease: float, term: float = TERM
) -> Claim | None:
    """Take the best job of ``queue`` that a worker can do; None: there is none.

    First comes the tenant with the fewest running jobs in the queue, of several the one whose next
    job has waited longest; then the tenant's highest priority; then the oldest. A tenant whose
    quota of running jobs is used up is passed over. The queue's last free worker is kept for
    tenants that have nothing running there, while one of them is present. Workers are those seen in
    the last ``term`` seconds; of one queue, they ask one after the other.
    """
    one_at_a_time(session, f"claims of {queue}")
    moment = clock(session)
    free_expired(session, queue)
    fits = (_waits(queue, moment), Job.kind.in_(who.kinds), _fits(who))
    is_kept: bool | None = None
    for tenant_id, load in _tenants(session, queue, fits):
        if load and is_kept is None:
            is_kept = _keeps_last(session, queue, moment - timedelta(seconds=term))
        if is_kept:
            return None
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


def free_expired(session: Session, *queues: str) -> None:
    """Take jobs back from workers that have been silent for longer than their lease."""
    session.connection()  # SQLite waits for other writers here: their leases are not the future
    ran_out = has_run_out(clock(session))
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


def _keeps_last(session: Session, queue: str, alive: datetime) -> bool:
    """Return whether one worker at most is free, and a tenant with none there may soon need it.

    Such a tenant has used a key lately that may submit jobs. An only worker is kept for nobody.
    """
    living = (Worker.queue == queue, Worker.seen_at > alive)
    workers = session.scalar(select(func.coalesce(func.sum(Worker.slots), 0)).where(*living)) or 0
    held = select(JOBS.tenant_id).where(JOBS.queue == queue, JOBS.state.in_(HELD))
    busy = session.scalars(held).all()
    if workers <= 1 or workers - len(busy) > 1:
        return False
    present = select(KEYS.scopes).where(
        KEYS.tenant_id.not_in(busy),
        KEYS.revoked_at.is_(None),
        KEYS.last_used_at > clock(session) - PRESENT,
    )
    return any(SUBMITS in scopes for scopes in session.scalars(present))


def _tenants(
    session: Session, queue: str, fits: Sequence[ColumnElement[bool]]
) -> Iterator[tuple[str, int]]:
    """Give tenants with a runnable job and the jobs they have running, in fair-share order."""
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
    order = (
        select(turns.c.tenant_id, turns.c.load)
        .join(waiting, waiting.id == turns.c.job_id)
        .order_by(turns.c.load, waiting.created_at, waiting.id)
    )
    yield from session.execute(order).tuples().all()


def _waits(queue: str, moment: datetime) -> ColumnElement[bool]:
    return (Job.queue == queue) & (Job.state == State.QUEUED) & is_due(Job, moment)


def _fits(who: Abilities) -> ColumnElement[bool]:
    return or_(Job.memory_mb.is_(None), Job.memory_mb <= who.memory_mb)


def positions(session: Session, jobs: Sequence[Job]) -> dict[str, int]:
    """Return the places of those of ``jobs`` that wait for a worker, 1 for the next.

    A tenant's turns alternate with those of the others, and one with running jobs waits for as many
    turns more. A job that was put off has no place until its time has come, and one of which its
    tenant has `MOST_TURNS` before it has none yet: of another's backlog no more is read than comes
    before these jobs.
    """
    found: dict[str, int] = {}
    waiting = [job for job in jobs if job.state is State.QUEUED]
    for queue in {job.queue for job in waiting}:
        found |= _places(session, queue, [job for job in waiting if job.queue == queue])
    return found


class _Turn(NamedTuple):
    """A waiting job's place in the queue; ties go to the older job."""

    number: int
    created_at: datetime
    job_id: str


def _places(session: Session, queue: str, jobs: Sequence[Job]) -> dict[str, int]:
    moment = clock(session)
    held = (
        select(JOBS.tenant_id, func.count())
        .where(JOBS.queue == queue, JOBS.state.in_(HELD))
        .group_by(JOBS.tenant_id)
    )
    loads: Counter[str] = Counter(dict(session.execute(held).all()))
    own = {job.tenant_id for job in jobs}
    turns = [
        turn
        for tenant_id in own
        for turn in _turns(session, queue, tenant_id, moment, loads[tenant_id], MOST_TURNS)
    ]
    wanted = {job.id for job in jobs}
    last = max((turn.number for turn in turns if turn.job_id in wanted), default=0)
    some = (
        select(JOBS.id)
        .where(JOBS.queue == queue, JOBS.state == State.QUEUED, JOBS.tenant_id == Tenant.id)
        .limit(1)
    )
    others = select(Tenant.id).where(Tenant.id.not_in(own), some.exists())
    for tenant_id in session.scalars(others) if last else ():
        before = last - loads[tenant_id]
        turns += _turns(session, queue, tenant_id, moment, loads[tenant_id], before)
    order = sorted(turn for turn in turns if turn.number <= last)
    return {turn.job_id: place for place, turn in enumerate(order, 1) if turn.job_id in wanted}


def _turns(
    session: Session, queue: str, tenant_id: str, moment: datetime, load: int, most: int
) -> list[_Turn]:
    """Return the places of a tenant's first waiting jobs, at most ``most`` of them."""
    if most <= 0:
        return []
    first = (
        select(JOBS.created_at, JOBS.id)
        .where(JOBS.queue == queue, JOBS.state == State.QUEUED, JOBS.tenant_id == tenant_id)
        .where(is_due(JOBS, moment))
        .order_by(*own_order(JOBS))
        .limit(most)
    )
    rows = enumerate(session.execute(first), load + 1)
    return [_Turn(number, created_at, job_id) for number, (created_at, job_id) in rows]
