"""Capture operations: create, change, landmarks, views, delete."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import PurePath

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.captures import repository
from service.captures.schemas import CaptureChange, CaptureView, Landmarks, NewCapture
from service.errors import Problem
from service.settings import Settings
from service.store.deletion import delete_capture
from service.store.models import Batch, Capture, Deletion, Job, Upload
from service.store.retention import own_days
from service.subjects import repository as subjects
from service.subjects.service import refuse_while_busy, relabel
from service.uploads import repository as uploads
from solver.kinds import ROLES, SCANS

# Windows has devices of these names, whatever follows the first dot
DEVICES = frozenset(
    {"con", "prn", "aux", "nul", *(f"{port}{i}" for port in ("com", "lpt") for i in range(10))}
)


def create(session: Session, subject_id: str, new: NewCapture) -> Capture:
    """Add a scan to a subject; its mesh is read by a worker, never here.

    The scan that it replaces is deleted in the same transaction: one of the two is always there.
    """
    # Two captures of one subject at a time would both find the name free.
    subjects.lock(session, subject_id)
    _require_file_name(new.name)
    upload = uploads.get_complete(session, new.upload_id)
    _check_role(upload, new)
    if new.replaces is not None:
        delete(session, subject_id, new.replaces)
    _refuse_a_second(session, subject_id, new.name, new.role)
    capture = Capture(
        subject_id=subject_id,
        name=new.name,
        title=new.title,
        role=new.role,
        registered=new.registered or new.role not in SCANS,
        labels=new.labels,
        filename=upload.filename,
        size=upload.size,
        sha256=upload.sha256,
        sent_sha256=upload.sent_sha256,
    )
    session.add(capture)
    session.flush()
    uploads.use(session, upload, capture.id)
    if new.landmarks_upload_id is not None:
        _give_landmarks(session, capture, new.landmarks_upload_id)
    if new.mask_upload_id is not None:
        _give_mask(session, capture, new.mask_upload_id)
    return capture


def change(session: Session, subject_id: str, capture_id: str, order: CaptureChange) -> Capture:
    """Change what a scan is called, what it is and its labels.

    Name and role stay while jobs or a batch work for the subject: what they leave bears the name,
    and a batch goes by the role. Title and labels are nobody's but people's.
    """
    subjects.lock(session, subject_id)
    capture = repository.get(session, subject_id, capture_id)
    name = order.name or capture.name
    role = order.role or capture.role
    if (name, role) != (capture.name, capture.role):
        if role != capture.role and capture.role not in SCANS:
            detail = f"{capture.name} stays what it is, {capture.role}: add it anew"
            raise Problem(422, f"capture.is_{capture.role}", detail, capture_id=capture.id)
        if name != capture.name:
            _require_file_name(name)
        refuse_while_busy(session, subject_id)
        _refuse_while_in_batch(session, subject_id)
        _refuse_a_second(session, subject_id, name, role, besides=capture.id)
    capture.name = name
    capture.role = role
    capture.title = order.title or capture.title
    relabel(capture, order.labels)
    return capture


def views(session: Session, captures: Sequence[Capture], settings: Settings) -> list[CaptureView]:
    """Show captures with the newest check and registration of each."""
    checks = _newest(repository.succeeded_jobs(session, "check_scan", captures))
    registrations = _newest(repository.succeeded_jobs(session, repository.REGISTRATION, captures))
    kept = own_days(session, settings)
    return [
        CaptureView.of(capture, checks.get(capture.id), registrations.get(capture.id), kept)
        for capture in captures
    ]


def set_landmarks(session: Session, subject_id: str, capture_id: str, given: Landmarks) -> Capture:
    """Give a scan landmarks, in place of those it had; jobs submitted earlier keep theirs."""
    capture = repository.get(session, subject_id, capture_id)
    _require_landmarks(capture.name, capture.role)
    _give_landmarks(session, capture, given.upload_id)
    return capture


def delete(session: Session, subject_id: str, capture_id: str) -> Deletion:
    """Delete a scan with its checks and registrations."""
    # A job submitted meanwhile would outlive the scan it reads.
    subjects.lock(session, subject_id)
    capture = repository.get(session, subject_id, capture_id)
    refuse_while_busy(session, subject_id)
    return delete_capture(session, capture, "request")


def _give_landmarks(session: Session, capture: Capture, upload_id: str) -> None:
    upload = uploads.get_complete(session, upload_id)
    formats = ROLES[capture.role].landmarks
    _check_format(upload, "landmarks.format", "a file of landmarks", formats)
    capture.landmarks_filename = upload.filename
    capture.landmarks_size = upload.size
    capture.landmarks_sha256 = upload.sha256
    uploads.use(session, upload, capture.id)


def _give_mask(session: Session, capture: Capture, upload_id: str) -> None:
    formats = ROLES[capture.role].masks
    if not formats:
        code = f"capture.is_{capture.role}"
        raise Problem(422, code, f"{capture.name}: {ROLES[capture.role].noun} takes no mask")
    upload = uploads.get_complete(session, upload_id)
    _check_format(upload, "capture.format", "a mask", formats)
    capture.mask_filename = upload.filename
    capture.mask_size = upload.size
    capture.mask_sha256 = upload.sha256
    uploads.use(session, upload, capture.id)


def _check_role(upload: Upload, new: NewCapture) -> None:
    """Refuse a file that is none of its role, and what goes with scans only."""
    role = ROLES[new.role]
    if role.is_scan:
        what = "a raw scan"
        formats = role.formats
        if new.registered:
            what = "a registered scan"
            formats = role.registered
        _check_format(upload, "capture.format", what, formats)
        return
    _check_format(upload, "capture.format", role.noun, (*role.formats, *role.sets))
    code = f"capture.is_{new.role}"
    if new.role == "performance" and "registered" in new.model_fields_set and not new.registered:
        raise Problem(422, code, f"{new.name}: {role.noun} holds registered points")
    if new.landmarks_upload_id is not None:
        _require_landmarks(new.name, new.role)


def _require_landmarks(name: str, role: str) -> None:
    if not ROLES[role].landmarks:
        raise Problem(422, f"capture.is_{role}", f"{name}: {ROLES[role].noun} takes no landmarks")


def _check_format(upload: Upload, code: str, what: str, formats: Sequence[str]) -> None:
    suffix = PurePath(upload.filename).suffix.lower()
    if suffix not in formats:
        own = next((name for name, role in ROLES.items() if suffix in role.own_formats), None)
        hint = f"; add it in the role {own}" if own else ""
        raise Problem(
            422,
            code,
            f"{upload.filename}: {what} is one of {', '.join(formats)}{hint}",
            file=upload.filename,
            expected=list(formats),
        )


def _require_file_name(name: str) -> None:
    """Refuse a name that a file cannot have on every system: jobs, archives and exports use it."""
    if name.endswith("."):
        detail = f"{name}: a name cannot end with a dot, which Windows takes off a file's name"
    elif name.partition(".")[0].lower() in DEVICES:
        detail = f"{name} is a device's name on Windows, and no file's: use another name"
    else:
        return
    raise Problem(422, "capture.name", detail, found=name)


def _as_a_file(name: str) -> str:
    return name.lower().rstrip(".")


def _refuse_while_in_batch(session: Session, subject_id: str) -> None:
    """Raise a problem while a batch goes on, also between two of its jobs."""
    running = select(Batch.id).where(Batch.subject_id == subject_id, Batch.state == "running")
    if batches := session.scalars(running).all():
        raise Problem(
            409,
            "subject.busy",
            "the subject has a batch that is not over; wait for it, or cancel it first",
            subject_id=subject_id,
            batch_ids=list(batches),
        )


def _refuse_a_second(
    session: Session, subject_id: str, name: str, role: str, besides: str | None = None
) -> None:
    """Raise a problem if the subject has a capture of this name, or another neutral.

    Names are in those of files, which some systems do not tell apart by case or a last dot.
    ``besides`` is the id of the capture that is to be called so.
    """
    for other in repository.of_subject(session, subject_id):
        if other.id == besides:
            continue
        if _as_a_file(other.name) == _as_a_file(name):
            raise Problem(
                409,
                "capture.name_taken",
                f"the subject has a capture named {other.name}: replace that, or rename this one",
                capture_id=other.id,
            )
        if other.role == role == "neutral":
            raise Problem(
                409,
                "capture.neutral_exists",
                f"the subject has a neutral capture, {other.name}; replace or delete it",
                capture_id=other.id,
            )


def _newest(jobs: Sequence[Job]) -> dict[str | None, Job]:
    return {job.capture_id: job for job in reversed(jobs)}
