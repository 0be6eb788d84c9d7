"""Bodies and views of batches."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Literal

from pydantic import ConfigDict, Field, model_validator

from service.captures.schemas import NewCapture, Role
from service.jobs.schemas import CancelView, JobError, Priority
from service.queue.states import State
from service.schemas import Id, Line, RequestBody, View
from service.subjects.schemas import NewSubject

Step = Literal["register", "model", "geometry"]
BatchState = Literal["running", "succeeded", "failed", "canceled"]


class StepOptions(RequestBody):
    """Options for the batch's jobs, by kind; `GET /v1/kinds` describes them."""

    check_scan: dict[str, Any] = Field(default={})
    register_scan: dict[str, Any] = Field(default={})
    build_model: dict[str, Any] = Field(default={})
    fit_geometry: dict[str, Any] = Field(default={})


class NewBatch(RequestBody):
    """The scans of a session, of a subject that is there or of a new one."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "subject": {"name": "Alex"},
                    "captures": [
                        {
                            "name": "neutral",
                            "role": "neutral",
                            "upload_id": "0b7f2f0c-50d3-4b84-a0b4-3b0a8b0c7a01",
                            "registered": False,
                        }
                    ],
                    "then": ["register", "model"],
                }
            ]
        },
    )

    name: Line = ""
    subject_id: Id | None = Field(default=None, description="or `subject`")
    subject: NewSubject | None = Field(default=None, description="a new one, or `subject_id`")
    captures: list[NewCapture] = Field(min_length=1, max_length=500)
    then: list[Step] = Field(
        default=["register", "model", "geometry"],
        description="what to make after the checks: registrations of the raw scans, the model, a "
        "rig of all expressions that can be used",
    )
    options: StepOptions = StepOptions()
    priority: Priority = 0

    @model_validator(mode="after")
    def _one_subject(self) -> NewBatch:
        if (self.subject_id is None) == (self.subject is None):
            raise ValueError("give either subject_id or subject")
        return self


class StepView(View):
    """A job of the batch."""

    job_id: str
    state: State


class CheckStepView(StepView):
    """The check of a scan; the findings are in its job's result."""

    verdict: str | None = Field(description="`good`, `usable` or `bad` when it is over")


class FitStepView(StepView):
    """The fit of all expressions."""

    rig_id: str | None


class ScanView(View):
    """Outcome of a scan."""

    capture_id: str
    name: str
    role: Role
    check: CheckStepView | None
    registration: StepView | None
    left_out: str | None = Field(description="why nothing more is made of it")


class BatchView(View):
    """A batch with the verdict of each scan."""

    id: str
    name: str
    subject_id: str
    state: BatchState
    then: list[Step]
    priority: int
    scans: list[ScanView]
    model: StepView | None
    fit: FitStepView | None
    error: JobError | None
    cancel: CancelView | None
    created_at: datetime
    finished_at: datetime | None
