"""Bodies, filters and views of jobs."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal, Self

from fastapi import Depends, Query
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field
from sqlalchemy import ColumnElement, select

from service.queue.states import State
from service.rigs.schemas import ArtifactView, verdict_in
from service.schemas import FileName, Id, Line, Moment, Name, RequestBody, RetainUntil, View
from service.store import retention
from service.store.deletion import is_read_by
from service.store.models import Artifact, Job
from solver.kinds import MOST_FILM_FRAMES

Priority = Annotated[
    int, Field(ge=-9, le=9, description="order among your own jobs of a queue: 9 first, -9 last")
]
Memory = Annotated[
    int | None,
    Field(ge=1, le=2**31 - 1, description="only workers that give a job so much memory take it"),
]

Deadline = Annotated[
    int | None,
    Field(
        ge=1,
        le=2**31 - 1,
        description="seconds after which an attempt is ended, if that is before the kind's "
        "`max_seconds`",
    ),
]

_COLUMNS = (
    "id",
    "priority",
    "memory_mb",
    "parent_id",
    "batch_id",
    "state",
    "attempt",
    "max_attempts",
    "not_before",
    "progress",
    "error",
    "attempts",
    "cancel",
    "last_event_id",
    "created_at",
    "started_at",
    "finished_at",
)


class FromJob(RequestBody):
    """A file that an earlier job of the subject left."""

    job: Id = Field(description="a job of the same subject that succeeded")
    artifact: FileName = Field(
        description="name of a file it left; which ones, `GET /v1/kinds` tells in `hands_on`"
    )
    name: Name | None = Field(
        default=None, description="by which a scene names it; default: the file's, without suffix"
    )


class NewJob(RequestBody):
    """A piece of work; which members a kind needs is in `GET /v1/kinds`."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [
                {
                    "kind": "check_scan",
                    "subject_id": "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11",
                    "captures": ["f2a6c0de-7d1b-4a54-8a55-5f9f3c8c9e02"],
                    "options": {"unit": "cm", "up": "z"},
                }
            ]
        },
    )

    kind: str
    subject_id: Id
    captures: list[Id] = Field(
        default=[],
        max_length=MOST_FILM_FRAMES,
        description="ids of expression captures; of one capture for `check_scan` and "
        "`register_scan`, of one performance for `fit_sequence`, of the assets that a scene names, "
        "of 1 to 16 photographs for kinds that read `photos`, of all pictures of a film or of its "
        "one file where their option `sequence` is true; beside what is fitted, of one table of "
        "known activations",
    )
    from_jobs: list[FromJob] = Field(
        default=[],
        max_length=100,
        description="files that earlier jobs left, read as captures are: a check's `markers.json`, "
        "a take's `sequence.npz`",
    )
    rig_id: Id | None = Field(default=None, description="the parent rig")
    options: dict[str, Any] = Field(default={}, description="the kind's options")
    priority: Priority = 0
    memory_mb: Memory = None
    deadline_s: Deadline = None


class Retry(RequestBody):
    """Changes for a job that is made again; the rest stays as it was."""

    captures: list[Id] | None = Field(default=None, max_length=MOST_FILM_FRAMES)
    from_jobs: list[FromJob] | None = Field(default=None, max_length=100)
    rig_id: Id | None = None
    options: dict[str, Any] = Field(
        default={}, description="options that differ; the others are the job's own"
    )
    priority: Priority | None = None
    memory_mb: Memory = None
    deadline_s: Deadline = None


class Cancel(RequestBody):
    """Order to stop a job."""

    reason: Line = ""
    by: Line = "api"


class Progress(BaseModel):
    """Progress of a job: `fraction` of the whole in [0, 1]; the error is in millimetres."""

    model_config = ConfigDict(extra="allow")

    phase: str
    fraction: float


class AttemptView(View):
    """One try by a worker."""

    number: int
    worker: str
    started_at: datetime
    finished_at: datetime | None
    outcome: Literal["succeeded", "failed", "canceled", "lost", "released", "postponed"] | None


class CancelView(View):
    """Request to stop the job: by whom, and why."""

    by: str
    reason: str
    requested_at: datetime


class JobError(BaseModel):
    """Error of a failed job; further members name the fault."""

    model_config = ConfigDict(extra="allow")

    code: str
    message: str


class ResultItem(View):
    """Result of a finished job, in short."""

    rig_id: str | None = None
    verdict: str | None = Field(description="of a check or a rig: `good`, `usable` or `bad`")


class Result(ResultItem):
    """Result of a finished job."""

    summary: dict[str, Any] | None = Field(
        description="a check's verdict and findings, or the figures of a registration, model or rig"
    )
    artifacts: list[ArtifactView]


class JobItem(View):
    """A job as lists show it."""

    id: str
    kind: str
    subject_id: str
    subject_name: str
    captures: list[str]
    from_jobs: list[FromJob] = Field(default=[])
    rig_id: str | None
    priority: int
    parent_id: str | None = Field(description="the job that this one is made again from")
    batch_id: str | None
    state: State
    attempt: int
    max_attempts: int = Field(description="attempts that may be lost before it fails")
    not_before: datetime | None = Field(description="put off until then: a disk was full")
    queue_position: int | None = Field(
        description="1 is next, by the order in which tenants take turns; null when not waiting, "
        "and while a thousand jobs of the tenant's own come before it"
    )
    phase: str | None
    progress: Progress | None
    error: JobError | None
    result: ResultItem | None
    attempts: list[AttemptView]
    cancel: CancelView | None
    last_event_id: int = Field(description="pass it as `Last-Event-ID` to watch what comes next")
    seconds: float | None = Field(description="how long it took; null: it has not ended, or begun")
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None
    retain_until: RetainUntil

    @classmethod
    def of(cls, job: Job, subject_name: str, place: int | None, kept: retention.Days) -> Self:
        """Show a job at its ``place`` in the queue."""
        shown = {name: getattr(job, name) for name in cls.model_fields if name in _COLUMNS}
        return cls.model_validate(
            {
                **job.request,
                **shown,
                "subject_name": subject_name,
                "queue_position": place,
                "phase": job.progress["phase"] if job.progress else None,
                "seconds": job.seconds,
                "retain_until": _retain_until(job, kept),
                "result": cls._result(job) if job.state is State.SUCCEEDED else None,
            }
        )

    @classmethod
    def _result(cls, job: Job) -> dict[str, Any]:
        return {"rig_id": job.rig.id if job.rig else None, "verdict": verdict_in(job.summary)}


class JobView(JobItem):
    """A job."""

    options: dict[str, Any]
    memory_mb: int | None
    deadline_s: int | None = None
    result: Result | None

    @classmethod
    def _result(cls, job: Job) -> dict[str, Any]:
        return {**super()._result(job), "summary": job.summary, "artifacts": job.artifacts}


def _retain_until(job: Job, kept: retention.Days) -> datetime | None:
    if job.rig is not None:
        return retention.until(kept.rigs, job.rig.created_at)
    return retention.until(kept.jobs, job.finished_at)


class LogLineView(View):
    """A line that the solver printed."""

    number: int
    attempt: int
    text: str


def _in_rows(given: Any) -> Any:
    """Return activations with a row for each muscle, which files of fibre muscles lack.

    An answer has one shape: of a union of lists many generators make code that does not compile.
    """
    if not isinstance(given, list):
        return given
    return [each if isinstance(each, list) else [each] for each in given]


Activations = Annotated[
    list[list[float]],
    BeforeValidator(_in_rows),
    Field(
        description="a row for each muscle: xx, xy, xz, yy, yz, zz, relaxed is 1, 0, 0, 1, 0, 1; "
        "of fibre muscles one number in [0, 1]"
    ),
]


class FrameView(BaseModel):
    """A fitted frame; angles in rad, lengths in mm."""

    frame: int = Field(description="its number in the performance")
    status: Literal["fitted", "kept", "unseen", "predicted", "smoothed"] = Field(
        description="`kept`: the fit failed, `unseen`: too little of the face is seen; "
        "both have the pose of the frame before; `predicted`: no marker is seen, the pose fades to "
        "rest; `smoothed`: the frames after it count too"
    )
    activations: Activations
    jaw: list[float] = Field(description="two rotations and three translations of the mandible")
    head: list[float] = Field(description="rotation vector and translation of the head")
    mean_mm: float | None
    p95_mm: float | None
    max_mm: float | None
    coverage: float = Field(description="share of the face that was seen")
    inverted: int
    iterations: int
    seconds: float


class MotionFrameView(BaseModel):
    """A frame of a simulation; angles in rad, lengths in mm, times in s."""

    frame: int = Field(description="its number, from 0")
    time: float
    activations: Activations
    jaw: list[float] = Field(description="two rotations and three translations of the mandible")
    head: list[float] = Field(description="rotation vector and translation of the head")
    eyes: list[list[float]] = Field(description="rotation vectors, the subject's left eye first")
    penetration_mm: float = Field(description="how deep skin is in what it meets, at the worst")
    behind_teeth: int = Field(description="vertices of the lips that are behind teeth")
    inverted: int
    iterations: int
    halvings: int = Field(description="how often the step had to be cut")
    residual: float
    seconds: float


class FramesView(BaseModel):
    """Frames of a sequence or simulation.

    Pass `next` as `start` to read on, `ready` are there by now.
    """

    frames: list[FrameView | MotionFrameView]
    next: int
    ready: int


class LogView(BaseModel):
    """Lines of a job's log; pass `next` as `after` to read on."""

    lines: list[LogLineView]
    next: int


async def _filters(
    subject_id: Annotated[Id | None, Query()] = None,
    capture_id: Annotated[Id | None, Query(description="checks and registrations of it")] = None,
    batch_id: Annotated[Id | None, Query()] = None,
    parent_id: Annotated[Id | None, Query(description="jobs made again from it")] = None,
    kind: Name | None = None,
    has: Annotated[FileName | None, Query(description="that have left a file of this name")] = None,
    reads: Annotated[
        Id | None, Query(description="that read a file of this capture, or that this job left")
    ] = None,
    state: Annotated[
        list[State] | None, Query(description="one of these; may be given several times")
    ] = None,
    since: Annotated[Moment | None, Query(description="created then or later")] = None,
    until: Annotated[Moment | None, Query(description="created before then")] = None,
) -> list[ColumnElement[bool]]:
    """Return what the jobs must fulfil, all that was given."""
    equal: dict[Any, object] = {
        Job.subject_id: subject_id,
        Job.capture_id: capture_id,
        Job.batch_id: batch_id,
        Job.parent_id: parent_id,
        Job.kind: kind,
    }
    conditions = [column == value for column, value in equal.items() if value is not None]
    if has is not None:
        # before it has succeeded, a job's files are not shown
        left = select(Artifact.id).where(Artifact.job_id == Job.id, Artifact.name == has)
        conditions += [Job.state == State.SUCCEEDED, left.exists()]
    if reads is not None:
        conditions.append(is_read_by(reads))
    if state:
        conditions.append(Job.state.in_(state))
    if since is not None:
        conditions.append(Job.created_at >= since)
    if until is not None:
        conditions.append(Job.created_at < until)
    return conditions


Filters = Annotated[list[ColumnElement[bool]], Depends(_filters)]
