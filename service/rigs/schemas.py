"""Views of rigs and artifacts."""

from __future__ import annotations

from datetime import datetime
from math import isfinite
from typing import Any, Self

from pydantic import BaseModel, Field

from service.rigs.repository import RigRow
from service.schemas import Change, LabelChanges, Line, RetainUntil, View
from service.store import retention

VERDICTS = ("good", "usable", "bad")


class ArtifactView(View):
    """A file that a job left."""

    id: str
    job_id: str
    name: str
    size: int
    sha256: str
    media_type: str
    format: int | None = Field(
        default=None,
        description="number of its format, of a file that later jobs read; null: not known",
    )


class RigItem(View):
    """A fitted face as lists show it."""

    id: str
    name: str = Field(description="what it was called; empty: nobody has called it anything")
    subject_id: str
    subject_name: str
    job_id: str
    parent_id: str | None
    expressions: list[str]
    labels: dict[str, str]
    verdict: str | None = Field(description="of its certificate: `good`, `usable` or `bad`")
    mean_mm: float | None = Field(description="mean distance to the scans that it was fitted to")
    seconds: float | None = Field(description="how long the job took that made it")
    created_at: datetime
    retain_until: RetainUntil

    @classmethod
    def of(cls, row: RigRow, kept: retention.Days) -> Self:
        """Show a rig."""
        rig = row.rig
        summary = row.rig.summary
        shown = {name: getattr(rig, name) for name in cls.model_fields if hasattr(rig, name)}
        return cls.model_validate(
            {
                **shown,
                "subject_name": row.subject_name,
                "verdict": verdict_in(summary),
                "mean_mm": _figure(summary.get("train_mean_mm", summary.get("mean_mm"))),
                "seconds": row.seconds,
                "retain_until": retention.until(kept.rigs, rig.created_at),
            }
        )


class RigView(RigItem):
    """A fitted face; `summary` holds the figures of `report.json`."""

    summary: dict[str, Any]
    artifacts: list[ArtifactView]


class RigChange(Change):
    """Changes of a rig; what is left out stays."""

    name: Line | None = Field(default=None, description="empty: it is called nothing again")
    labels: LabelChanges | None = None


def verdict_in(summary: dict[str, Any] | None) -> str | None:
    """Return the verdict that a job has left, if it left one: a solver wrote it."""
    found = (summary or {}).get("verdict")
    return found if found in VERDICTS else None


def _figure(value: Any) -> float | None:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and isfinite(value) else None


class SignedUrl(BaseModel):
    """A URL that works without a key, relative to the service's, until ``expires_at``."""

    url: str = Field(examples=["/v1/artifacts/4d8e0f9a-...?signed=default.1764000000.Qk3..."])
    expires_at: datetime
