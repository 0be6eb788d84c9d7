"""What can be done with captures."""

from __future__ import annotations

from pathlib import PurePath

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.captures import repository
from service.captures.schemas import NewCapture
from service.errors import Problem
from service.store.models import Capture, Subject
from service.subjects import repository as subjects
from service.subjects.service import refuse_while_busy
from service.uploads import repository as uploads

FORMATS = (".obj", ".ply", ".glb", ".stl")


def create(session: Session, subject_id: str, new: NewCapture) -> Capture:
    """Add a scan to a subject; its mesh is read by a worker, never here."""
    subjects.get(session, subject_id)
    # Two captures of one subject at a time would both find the name free.
    session.execute(select(Subject.id).where(Subject.id == subject_id).with_for_update())
    upload = uploads.get_complete(session, new.upload_id)
    if PurePath(upload.filename).suffix.lower() not in FORMATS:
        raise Problem(
            422,
            "capture.format",
            f"{upload.filename}: a scan is one of {', '.join(FORMATS)}",
            file=upload.filename,
            expected=list(FORMATS),
        )
    for other in repository.of_subject(session, subject_id):
        if other.name == new.name:
            raise Problem(
                409,
                "capture.name_taken",
                f"the subject has a capture named {new.name}: delete that, or rename this one",
                capture_id=other.id,
            )
        if other.role == new.role == "neutral":
            raise Problem(
                409,
                "capture.neutral_exists",
                f"the subject has a neutral capture, {other.name}; delete it first",
                capture_id=other.id,
            )
    capture = Capture(
        subject_id=subject_id,
        name=new.name,
        role=new.role,
        filename=upload.filename,
        size=upload.size,
        sha256=upload.sha256,
    )
    session.add(capture)
    session.flush()
    return capture


def delete(session: Session, subject_id: str, capture_id: str) -> None:
    """Delete a scan; the sweeper removes the file."""
    capture = repository.get(session, subject_id, capture_id)
    refuse_while_busy(session, subject_id)
    uploads.forget_scans(session, [capture.sha256])
    session.delete(capture)
