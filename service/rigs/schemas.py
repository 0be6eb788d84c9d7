"""Views of rigs and artifacts."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from pydantic import BaseModel, Field

from service.schemas import RetainUntil, View
from service.store import retention
from service.store.models import Rig


class ArtifactView(View):
    """A file that a job left."""

    id: str
    job_id: str
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
    retain_until: RetainUntil

    @classmethod
    def of(cls, rig: Rig, kept: retention.Days) -> RigView:
        """Show a rig."""
        columns = {name: getattr(rig, name) for name in cls.model_fields if hasattr(rig, name)}
        until = retention.until(kept.rigs, rig.created_at)
        return cls.model_validate({**columns, "retain_until": until})


class SignedUrl(BaseModel):
    """A URL that works without a key, relative to the service's, until ``expires_at``."""

    url: str = Field(examples=["/v1/artifacts/4d8e0f9a-...?signed=default.1764000000.Qk3..."])
    expires_at: datetime
