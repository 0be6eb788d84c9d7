"""How many jobs of a tenant run at a time: no more than its quota."""

from __future__ import annotations

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.store.models import Job, Tenant
from service.store.store import wake
from service.store.transitions import HELD, State


def may_run_more(session: Session, tenant_id: str) -> bool:
    """Tell whether another job of a tenant may run; for one with a quota, workers ask in turn."""
    tenant = session.get_one(Tenant, tenant_id)
    if not _has_room(session, tenant):
        return False  # without the lock: who goes on to another tenant must hold none
    if tenant.max_running is not None:
        session.refresh(tenant, with_for_update={"key_share": True})
    return _has_room(session, tenant)


def call_waiting(session: Session, tenant_id: str) -> None:
    """Wake a worker of each queue in which a job may have waited for the tenant's quota."""
    if session.get_one(Tenant, tenant_id).max_running is None:
        return
    waiting = select(Job.queue, func.min(Job.id)).where(
        Job.tenant_id == tenant_id, Job.state == State.QUEUED
    )
    for queue, job_id in session.execute(waiting.group_by(Job.queue)).all():
        wake(session, job_id, queue)


def _has_room(session: Session, tenant: Tenant) -> bool:
    if tenant.max_running is None:
        return True
    held = select(func.count(Job.id)).where(Job.tenant_id == tenant.id, Job.state.in_(HELD))
    return (session.scalar(held) or 0) < tenant.max_running
