"""Retention: stated on each object by ``retain_until``, enforced by the sweeper.

What jobs are still reading waits for them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, Select, delete, exists, or_, select, union
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased

from service.queue.states import FINAL
from service.settings import Settings
from service.store import deletion
from service.store.database import Store, clock
from service.store.models import (
    AnsweredRequest,
    AuditEntry,
    Capture,
    Deletion,
    Job,
    Rig,
    Subject,
    Tenant,
    is_preview_of_any,
)
from service.store.tenancy import own_tenant

# Lifetime of an `Idempotency-Key`
ANSWERED = timedelta(days=1)
# Most objects deleted in a round
BATCH = 200
# Of what is kept: settings and tenants have a `retain_` of each
KINDS = ("subjects", "scans", "jobs", "rigs")


@dataclass(frozen=True)
class Days:
    """Days that things are kept, of each kind; None: until somebody deletes them."""

    subjects: int | None
    scans: int | None
    jobs: int | None
    rigs: int | None


def days(settings: Settings, tenant: Tenant | None = None) -> Days:
    """Return the installation's days, or a tenant's: its own where those are fewer."""
    owners = (settings, tenant) if tenant else (settings,)
    stated = {kind: [getattr(owner, f"retain_{kind}") for owner in owners] for kind in KINDS}
    return Days(**{kind: _fewest(each) for kind, each in stated.items()})


def _fewest(stated: Iterable[int | None]) -> int | None:
    return min((most for most in stated if most is not None), default=None)


def own_days(session: Session, settings: Settings) -> Days:
    """Return the days of the tenant whose session this is."""
    return days(settings, own_tenant(session))


def until(days: int | None, since: datetime | None) -> datetime | None:
    """Return when something is to go that is kept for ``days``; None: when somebody deletes it."""
    return None if days is None or since is None else since + timedelta(days=days)


def enforce(store: Store, settings: Settings) -> None:
    """Delete what has been kept for long enough, and what was waiting for its jobs to end.

    In many short transactions: SQLite has one writer at a time, and the others wait.
    """
    with store.write() as session:
        deletion.go_on(session)
        moment = clock(session)
        session.execute(
            delete(AnsweredRequest).where(AnsweredRequest.created_at < moment - ANSWERED)
        )
        if settings.retain_audit is not None:
            age = moment - timedelta(days=settings.retain_audit)
            session.execute(delete(AuditEntry).where(AuditEntry.created_at < age))
            session.execute(delete(Deletion).where(Deletion.files_at < age))
    with store.read() as session:
        tenants = session.scalars(select(Tenant).where(_has_own_days())).all()
    left = BATCH
    for tenant in (None, *tenants):
        for most, since, query, remove in _rules(days(settings, tenant)):
            if most is None or not left:
                continue
            due = query.where(since < moment - timedelta(days=most)).limit(left)
            if tenant is not None:
                due = due.where(since.class_.tenant_id == tenant.id)
            left -= _delete(store, due, remove)


def _delete(store: Store, due: Select[Any], remove: Remove) -> int:
    """Delete what is due in a transaction of its own; returns how much it was."""
    with store.read() as session:
        if session.scalars(due.limit(1)).first() is None:
            return 0  # and nobody waits for this
    with store.write() as session:
        rows = session.scalars(due).all()
        for row in rows:
            remove(session, row, "retention")
    return len(rows)


Remove = Callable[[Session, Any, deletion.Reason], Deletion]
Rule = tuple[int | None, InstrumentedAttribute[Any], Select[Any], Remove]


def _rules(kept: Days) -> Iterable[Rule]:
    """Return what is kept for how many days, since when, which rows, and how they go."""
    # by sets that are made once, not by a look at all rigs for every job
    models = select(Rig.model_job_id).where(Rig.model_job_id.is_not(None))
    made = union(select(Rig.job_id), models)
    free = (Job.id.not_in(made), ~is_preview_of_any(select(Rig.id)))
    ended = select(Job).where(Job.state.in_(FINAL), *free, _idle(Job.subject_id))
    of_rigs = select(Job).join(Rig, Rig.job_id == Job.id).where(_idle(Job.subject_id))
    scans = select(Capture).where(_idle(Capture.subject_id))
    people = select(Subject).where(_idle(Subject.id))
    return (
        (kept.subjects, Subject.created_at, people, deletion.delete_subject),
        (kept.scans, Capture.created_at, scans, deletion.delete_capture),
        (kept.rigs, Rig.created_at, of_rigs, deletion.delete_job),
        (kept.jobs, Job.finished_at, ended, deletion.delete_job),
    )


def _has_own_days() -> ColumnElement[bool]:
    return or_(*(getattr(Tenant, f"retain_{kind}").is_not(None) for kind in KINDS))


def _idle(subject_id: InstrumentedAttribute[Any]) -> ColumnElement[bool]:
    """Return whether no job of a subject is waiting or running."""
    other = aliased(Job)
    return ~exists().where(other.subject_id == subject_id, other.state.not_in(FINAL))
