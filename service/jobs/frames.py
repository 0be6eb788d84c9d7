"""The frames of a sequence, from the files that its solver left so far."""

from __future__ import annotations

import json
from typing import Any

from sqlalchemy.orm import Session

from service.errors import Problem
from service.jobs.repository import get
from service.kinds import KINDS
from service.store import jobs
from service.store.files import Files


def read(
    session: Session, files: Files, job_id: str, start: int, limit: int
) -> tuple[list[dict[str, Any]], int]:
    """Return the frames from the ``start``-th on, at most ``limit``, and how many are ready."""
    job = get(session, job_id)
    if KINDS[job.kind].leaves != "sequence":
        raise Problem(409, "job.no_frames", f"a {job.kind} job has no frames", job_id=job_id)
    chunks = jobs.frames(session, job_id)
    found: list[dict[str, Any]] = []
    for chunk in chunks:
        if chunk.first < start + limit and chunk.last >= start:
            frames = json.loads(files.read(chunk.sha256))["frames"]
            found += frames[max(start - chunk.first, 0) : start + limit - chunk.first]
    return found, chunks[-1].last + 1 if chunks else 0
