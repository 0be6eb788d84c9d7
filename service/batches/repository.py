"""Queries about batches, and what their jobs say of each scan and step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from service import paging
from service.errors import not_found
from service.paging import Slice
from service.queue.states import FINAL, State
from service.store.models import Batch, Capture, Job

# Ids in a statement: PostgreSQL takes 65,535 parameters, SQLite 32,766
AT_ONCE = 10_000

CHECK = "check_scan"
REGISTER = "register_scan"
MODEL = "build_model"
FIT = "fit_geometry"


def get(session: Session, batch_id: str) -> Batch:
    """Return a batch."""
    batch = session.get(Batch, batch_id)
    if batch is None:
        raise not_found("batch", batch_id)
    return batch


def lock(session: Session, batch_id: str) -> Batch:
    """Return a batch that nobody else can change until the commit."""
    batch = session.get(Batch, batch_id, with_for_update=True, populate_existing=True)
    if batch is None:
        raise not_found("batch", batch_id)
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


def list_running(session: Session) -> Sequence[tuple[str, str]]:
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


class ScanStatus(Enum):
    """Readiness of a scan."""

    WAITING = "waiting"
    TO_REGISTER = "to register"
    READY = "ready"
    OUT = "out"


@dataclass(frozen=True)
class BatchProgress:
    """A batch's scans, in the order given, and the newest job of each kind and scan."""

    batch: Batch
    scans: list[Capture]
    _jobs: dict[tuple[str, str | None], Job] = field(repr=False)

    @classmethod
    def of(
        cls, batch: Batch, captures: Mapping[str, Capture], jobs: Sequence[Job]
    ) -> BatchProgress:
        """Sort a batch's rows; ``captures`` by id, ``jobs`` the oldest first."""
        scans = [captures[one] for one in batch.capture_ids if one in captures]
        return cls(batch, scans, {(job.kind, job.capture_id): job for job in jobs})

    @property
    def neutral(self) -> Capture | None:
        """The neutral, if it is among the batch's scans."""
        return next((scan for scan in self.scans if scan.role == "neutral"), None)

    @property
    def expressions(self) -> list[Capture]:
        """The expressions among the scans."""
        return [scan for scan in self.scans if scan.role == "expression"]

    def job(self, kind: str, capture_id: str | None = None) -> Job | None:
        """Return the job of a kind, about a scan if it is about one."""
        return self._jobs.get((kind, capture_id))

    def status_of(self, scan: Capture) -> tuple[ScanStatus, str | None]:
        """Return what can be made of a scan; if nothing, why."""
        check = self.job(CHECK, scan.id)
        if check is None:
            return ScanStatus.READY, None
        if check.state not in FINAL:
            return ScanStatus.WAITING, None
        if check.state is not State.SUCCEEDED:
            return ScanStatus.OUT, f"its check {_describe_end(check)}"
        assert check.summary is not None, "a check leaves its verdict"
        if check.summary["verdict"] == "bad":
            return ScanStatus.OUT, _quote_errors(check.summary)
        if scan.registered or "register" not in self.batch.steps:
            return ScanStatus.READY, None
        registration = self.job(REGISTER, scan.id)
        if registration is None:
            return ScanStatus.TO_REGISTER, None
        if registration.state not in FINAL:
            return ScanStatus.WAITING, None
        if registration.state is not State.SUCCEEDED:
            return ScanStatus.OUT, f"its registration {_describe_end(registration)}"
        return ScanStatus.READY, None


def failure(job: Job) -> dict[str, str]:
    """Return the error of a batch that cannot go on without a job."""
    return {
        "code": "batch.job_failed",
        "message": f"{job.kind} {_describe_end(job)}",
        "job_id": job.id,
    }


def _quote_errors(summary: Mapping[str, Any]) -> str:
    """Return what a check says of a scan that cannot be used, and what it advises."""
    errors = [each for each in summary.get("findings", ()) if each.get("severity") == "error"]
    told = [f"{each['message'].rstrip('.')}. {each.get('advice', '')}".strip() for each in errors]
    return " ".join(told) or "its check says that it cannot be used: scan again"


def _describe_end(job: Job) -> str:
    if job.state is State.CANCELED or job.error is None:
        return "was canceled"
    return f"failed: {job.error['message']}"
