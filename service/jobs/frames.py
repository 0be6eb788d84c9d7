"""The frames of a sequence or simulation, from the files that its solver left so far."""

from __future__ import annotations

import base64
import json
from typing import Any

from sqlalchemy.orm import Session

from service.errors import Problem
from service.jobs.repository import get
from service.store import jobs
from service.store.files import Files
from solver.kinds import KINDS


def read(
    session: Session, files: Files, job_id: str, start: int, limit: int
) -> tuple[list[dict[str, Any]], int]:
    """Return the frames from the ``start``-th on, at most ``limit``, and how many are ready."""
    _check(session, job_id)
    chunks = jobs.frames(session, job_id)
    found: list[dict[str, Any]] = []
    for chunk in chunks:
        if chunk.first < start + limit and chunk.last >= start:
            frames = json.loads(files.read(chunk.sha256))["frames"]
            found += frames[max(start - chunk.first, 0) : start + limit - chunk.first]
    return found, chunks[-1].last + 1 if chunks else 0


def newest_picture(session: Session, files: Files, job_id: str) -> bytes | None:
    """Return a JPEG of the newest frame that has one, None before there is any."""
    _check(session, job_id)
    for chunk in reversed(jobs.frames(session, job_id)):
        if picture := json.loads(files.read(chunk.sha256)).get("picture"):
            return base64.b64decode(picture)
    return None


def _check(session: Session, job_id: str) -> None:
    job = get(session, job_id)
    if not KINDS[job.kind].frames:
        raise Problem(409, "job.no_frames", f"a {job.kind} job has no frames", job_id=job_id)
