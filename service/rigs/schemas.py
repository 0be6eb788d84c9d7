"""What the API says about rigs and artifacts."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from service.schemas import View


class ArtifactView(View):
    """A file that a job left."""

    id: str
    name: str
    size: int
    sha256: str
    media_type: str


class RigView(View):
    """A fitted face; `summary` holds the figures of `report.json`."""

    id: str
    subject_id: str
    job_id: str
    parent_id: str | None
    expressions: list[str]
    summary: dict[str, Any]
    artifacts: list[ArtifactView]
    created_at: datetime
