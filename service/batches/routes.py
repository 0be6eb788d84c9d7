"""Routes of batches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from fastapi import APIRouter, Query
from sqlalchemy.orm import Session

from service.access.principal import Writer
from service.batches import repository, service
from service.batches.repository import CHECK, FIT, MODEL, REGISTER, BatchProgress
from service.batches.schemas import BatchState, BatchView, NewBatch
from service.dependencies import BallastDep, Cursor, Limit, ReadSession, SettingsDep, WriteSession
from service.errors import problems
from service.idempotency import Once
from service.jobs.schemas import Cancel
from service.records.audit import record
from service.schemas import Id, Page
from service.store.models import Batch, Capture, Job

router = APIRouter(prefix="/v1/batches", tags=["batches"])


@router.post(
    "", status_code=201, summary="Add a session's scans", responses=problems(404, 409, 410, 422)
)
def create(
    new: NewBatch,
    session: WriteSession,
    once: Once,
    who: Writer,
    settings: SettingsDep,
    ballast: BallastDep,
) -> BatchView:
    """Make complete uploads the scans of a subject, check them and make of them what is asked.

    All of it or nothing. A scan that its check calls bad, or that cannot be registered, is left
    out; the batch goes on with the others, but not without the neutral.
    """
    if (known := once.find_answered(session, new)) is not None:
        return _views(session, [repository.get(session, known)])[0]
    replaces = [capture.replaces for capture in new.captures if capture.replaces]
    if replaces:
        ballast.drop()  # what deletes finds room on a full disk
    batch = service.create(session, new, settings.max_attempts)
    once.keep(session, batch.id)
    for replaced in replaces:
        record(session, who, "capture.deleted", replaced)
    record(session, who, "batch.created", batch.id)
    return _views(session, [batch])[0]


@router.get("", summary="List batches", responses=problems(422))
def index(
    session: ReadSession,
    subject_id: Annotated[Id | None, Query()] = None,
    state: BatchState | None = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[BatchView]:
    """List batches, newest first."""
    found = repository.newest(session, subject_id, state, limit, cursor)
    return Page(items=_views(session, found.items), next=found.next)


@router.get("/{batch_id}", summary="Show a batch", responses=problems(404, 422))
def show(batch_id: Id, session: ReadSession) -> BatchView:
    """Show a batch with the verdict of each scan."""
    return _views(session, [repository.get(session, batch_id)])[0]


@router.post("/{batch_id}/cancel", summary="Stop a batch", responses=problems(404, 409, 422))
def cancel(
    batch_id: Id, session: WriteSession, who: Writer, order: Cancel | None = None
) -> BatchView:
    """Stop a batch and its jobs; what is finished stays."""
    service.cancel(session, batch_id, order or Cancel())
    record(session, who, "batch.canceled", batch_id)
    return _views(session, [repository.get(session, batch_id)])[0]


def _views(session: Session, batches: Sequence[Batch]) -> list[BatchView]:
    """Show batches, with a few queries for all of them."""
    session.flush()
    ids = [capture_id for batch in batches for capture_id in batch.capture_ids]
    captures = repository.captures(session, ids)
    jobs: dict[str | None, list[Job]] = {}
    for job in repository.jobs(session, [batch.id for batch in batches]):
        jobs.setdefault(job.batch_id, []).append(job)
    return [_view(BatchProgress.of(batch, captures, jobs.get(batch.id, []))) for batch in batches]


def _view(at: BatchProgress) -> BatchView:
    batch = at.batch
    fit = at.job(FIT)
    return BatchView.model_validate(
        {
            **{name: getattr(batch, name) for name in _COLUMNS},
            "then": batch.steps,
            "scans": [_scan(at, scan) for scan in at.scans],
            "model": _step(at.job(MODEL)) or None,
            "fit": fit and {**_step(fit), "rig_id": fit.rig.id if fit.rig else None},
        }
    )


_COLUMNS = (
    "id",
    "name",
    "subject_id",
    "state",
    "priority",
    "error",
    "cancel",
    "created_at",
    "finished_at",
)


def _scan(at: BatchProgress, scan: Capture) -> dict[str, object]:
    check = at.job(CHECK, scan.id)
    return {
        "capture_id": scan.id,
        "name": scan.name,
        "role": scan.role,
        "check": check and {**_step(check), "verdict": (check.summary or {}).get("verdict")},
        "registration": _step(at.job(REGISTER, scan.id)) or None,
        "left_out": at.status_of(scan)[1],
    }


def _step(job: Job | None) -> dict[str, object]:
    return {"job_id": job.id, "state": job.state} if job else {}
