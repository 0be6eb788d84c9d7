"""Where queued jobs stand, in the order in which workers will take them."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import func, or_, select
from sqlalchemy.orm import Session

from service.store.claims import own_order
from service.store.database import clock
from service.store.models import Job
from service.store.transitions import HELD, State

JOBS = Job.__table__.c
"""Places count the jobs of all tenants, so these queries go round the tenant's view of `Job`."""


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
