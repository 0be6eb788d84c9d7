"""Routes of captures."""

from __future__ import annotations

from fastapi import APIRouter, Response

from service.access.principal import Deleter, Writer
from service.captures import repository, service
from service.captures.schemas import CaptureChange, CaptureView, Landmarks, NewCapture
from service.dependencies import (
    BallastDep,
    Cursor,
    DeleteSession,
    Limit,
    ReadSession,
    SettingsDep,
    WithLabels,
    WriteSession,
)
from service.errors import problems
from service.idempotency import Once
from service.records.audit import record
from service.records.routes import answer_deletion
from service.schemas import Id, Page
from service.subjects import repository as subjects

router = APIRouter(prefix="/v1/subjects/{subject_id}/captures", tags=["captures"])


@router.post("", status_code=201, summary="Add a scan", responses=problems(404, 409, 410, 422))
def create(
    subject_id: Id,
    new: NewCapture,
    session: WriteSession,
    who: Writer,
    once: Once,
    settings: SettingsDep,
    ballast: BallastDep,
) -> CaptureView:
    """Make a complete upload the subject's neutral, an expression or a performance.

    OBJ, PLY, GLB or STL; a raw scan (`registered: false`) may also be an XYZ point cloud. The
    frames of a performance are a NumPy array (frames, vertices, 3) in mm. The scan that
    `replaces` names is deleted in the same step, or nothing is done; that needs no scope `delete`.
    """
    if (known := once.find_answered(session, new)) is not None:
        capture = repository.get(session, subject_id, known)
    else:
        if new.replaces is not None:
            ballast.drop()  # what deletes finds room on a full disk
        capture = service.create(session, subject_id, new)
        once.keep(session, capture.id)
        if new.replaces is not None:
            record(session, who, "capture.deleted", new.replaces)
        record(session, who, "capture.created", capture.id)
    return service.views(session, [capture], settings)[0]


@router.get("", summary="List a subject's scans", responses=problems(404, 422))
def index(
    subject_id: Id,
    session: ReadSession,
    settings: SettingsDep,
    label: WithLabels = None,
    limit: Limit = 100,
    cursor: Cursor = None,
) -> Page[CaptureView]:
    """List a subject's captures, newest first."""
    subjects.get(session, subject_id)
    found = repository.newest(session, subject_id, label, limit, cursor)
    return Page(items=service.views(session, found.items, settings), next=found.next)


@router.get("/{capture_id}", summary="Show a scan", responses=problems(404, 422))
def show(
    subject_id: Id, capture_id: Id, session: ReadSession, settings: SettingsDep
) -> CaptureView:
    """Show a capture with its newest check and registration."""
    return service.views(session, [repository.get(session, subject_id, capture_id)], settings)[0]


@router.patch("/{capture_id}", summary="Change a scan", responses=problems(404, 409, 422))
def change(
    subject_id: Id,
    capture_id: Id,
    order: CaptureChange,
    session: WriteSession,
    who: Writer,
    settings: SettingsDep,
) -> CaptureView:
    """Give a scan another name, title or role, or other labels.

    Name and role stay while the subject has jobs or a batch that are not over. What was found of
    the scan in another role counts no more: check it, and register it, again.
    """
    capture = service.change(session, subject_id, capture_id, order)
    record(session, who, "capture.changed", capture_id)
    return service.views(session, [capture], settings)[0]


@router.put(
    "/{capture_id}/landmarks",
    summary="Give a scan landmarks, or a photograph what is known of it",
    responses=problems(404, 409, 410, 422),
)
def set_landmarks(
    subject_id: Id,
    capture_id: Id,
    given: Landmarks,
    session: WriteSession,
    who: Writer,
    settings: SettingsDep,
) -> CaptureView:
    """Make a complete upload (JSON, LJSON or CSV) the scan's landmarks, instead of earlier ones.

    Of a photograph it is the JSON with what is known of it.
    """
    capture = service.set_landmarks(session, subject_id, capture_id, given)
    record(session, who, "capture.landmarks", capture_id)
    return service.views(session, [capture], settings)[0]


@router.delete(
    "/{capture_id}", status_code=204, summary="Delete a scan", responses=problems(404, 409, 422)
)
def delete(subject_id: Id, capture_id: Id, session: DeleteSession, who: Deleter) -> Response:
    """Delete a capture with its checks and registrations, for example to replace a bad scan."""
    receipt = service.delete(session, subject_id, capture_id)
    record(session, who, "capture.deleted", capture_id)
    return answer_deletion(receipt)
