"""Bodies and views of captures."""

from __future__ import annotations

from datetime import datetime
from pathlib import PurePath
from typing import TYPE_CHECKING, Literal

from pydantic import ConfigDict, Field

from service.captures.repository import neutral_of, registered_mesh
from service.schemas import (
    Change,
    Id,
    LabelChanges,
    Labels,
    Name,
    RequestBody,
    RetainUntil,
    Title,
    View,
)
from service.store import retention
from service.store.models import Capture, Job
from solver.kinds import ROLES, SCANS

LONGEST_TITLE = 200
if TYPE_CHECKING:
    Role = str
    ScanRole = str
else:
    Role = Literal[tuple(ROLES)]
    ScanRole = Literal[SCANS]


class NewCapture(RequestBody):
    """A scan, as the file of a complete upload."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "name": "smile",
                    "role": "expression",
                    "upload_id": "0b7f2f0c-50d3-4b84-a0b4-3b0a8b0c7a01",
                    "registered": False,
                }
            ]
        },
    )

    name: Name
    title: Title | None = Field(
        default=None, description="what people call it; default: the name of its file"
    )
    role: Role = Field(
        description="what the file is; `GET /v1/limits` has the endings of each role's files. "
        "A `performance` is frames of registered skin points, `markers` a take of them or their "
        "set, `activations` a table of what is known of single muscles, as by EMG, `photo` a "
        "photograph, `film` a film of a face, an `asset` what scenes name: a recording, a fitted "
        "sequence, a mesh, a map"
    )
    upload_id: Id
    registered: bool = Field(
        default=False,
        description="true: the file has the template's vertices in its order; "
        "false: it is what the scanner made, and `register_scan` comes before models and fits. "
        "Performances are registered without being said to be",
    )
    landmarks_upload_id: Id | None = Field(
        default=None,
        description="a complete upload with landmarks on this scan, or of a photograph "
        "with what is known of it",
    )
    mask_upload_id: Id | None = Field(
        default=None,
        description="a complete upload with a photograph's mask, a PNG, white where it counts",
    )
    replaces: Id | None = Field(
        default=None,
        description="a scan of the subject that is deleted, with its checks and registrations, "
        "when this one is there; both may have one name",
    )
    labels: Labels = Field(default={})


class CaptureChange(Change):
    """Changes of a scan; what is left out stays."""

    name: Name | None = None
    title: Title | None = None
    role: ScanRole | None = Field(
        default=None, description="of a scan; what is none, as a take of markers, stays what it is"
    )
    labels: LabelChanges | None = None


class Landmarks(RequestBody):
    """Landmarks on a scan, or what is known of a photograph, as the file of a complete upload."""

    upload_id: Id


class CheckView(View):
    """The newest check of a scan; the findings are in its job's result."""

    job_id: str
    verdict: str = Field(description="`good`, `usable` or `bad`")
    finished_at: datetime


class RegistrationView(View):
    """The newest registration of a raw scan: `artifact_id` is its mesh."""

    job_id: str
    artifact_id: str
    sha256: str
    neutral_sha256: str | None = Field(
        description="of an expression: the registered neutral that it was made from"
    )
    finished_at: datetime


class CaptureView(View):
    """A named scan of a subject; `landmarks` is the name of their file, `mask` that of one.

    `sha256` is that of the file as it was sent; of a photograph's bytes others are stored.
    """

    id: str
    subject_id: str
    name: str
    title: str
    role: Role
    registered: bool
    labels: dict[str, str]
    filename: str
    size: int
    sha256: str
    landmarks: str | None
    mask: str | None
    check: CheckView | None
    registration: RegistrationView | None
    created_at: datetime
    retain_until: RetainUntil

    @classmethod
    def of(
        cls, capture: Capture, check: Job | None, registration: Job | None, kept: retention.Days
    ) -> CaptureView:
        """Show a capture with the newest jobs about it."""
        return cls.model_validate(
            {
                **{name: getattr(capture, name) for name in _COLUMNS},
                "title": capture.title or PurePath(capture.filename).stem[:LONGEST_TITLE],
                "sha256": capture.sent_sha256 or capture.sha256,
                "landmarks": capture.landmarks_filename,
                "mask": capture.mask_filename,
                "check": check and _check(check),
                "registration": registration and _registration(registration),
                "retain_until": retention.until(kept.scans, capture.created_at),
            }
        )


_COLUMNS = (
    "id",
    "subject_id",
    "name",
    "role",
    "registered",
    "labels",
    "filename",
    "size",
    "created_at",
)


def _check(job: Job) -> dict[str, object]:
    assert job.summary is not None, "a check leaves its verdict"
    return {"job_id": job.id, "verdict": job.summary["verdict"], "finished_at": job.finished_at}


def _registration(job: Job) -> dict[str, object]:
    made = registered_mesh(job)
    return {
        "job_id": job.id,
        "artifact_id": made.id,
        "sha256": made.sha256,
        "neutral_sha256": neutral_of(job),
        "finished_at": job.finished_at,
    }
