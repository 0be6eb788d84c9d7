"""Typed values of the API's answers; fields this client does not know are ignored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Annotated, Any, Literal

from myoface.names import is_device, same_file
from myoface.roles import Role
from myoface.values import Resource, ValueFaultError, matching

State = Literal["queued", "running", "canceling", "succeeded", "failed", "canceled"]

Then = Literal["register", "model", "geometry"]

FINAL_STATES: frozenset[State] = frozenset({"succeeded", "failed", "canceled"})


# What becomes a file's or a folder's name here is a plain name, whatever a service says
FileName = Annotated[
    str,
    matching(
        r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,254}$",
        "a plain file name of at most 255 letters, digits, '_', '.' and '-'",
    ),
]
Sha256 = Annotated[str, matching(r"^[0-9a-f]{64}$", "a sha256 of 64 hexadecimal digits")]


# What a studio notes of a subject, scan or rig; a label that is changed to None is taken away
Labels = Mapping[str, str]
LabelChanges = Mapping[str, str | None]
# Labels that a list is asked for; None stands for any value
LabelFilter = Mapping[str, str | None]


def as_query(labels: LabelFilter | None) -> list[str] | None:
    """Return labels as a list is asked for them."""
    pairs = (labels or {}).items()
    return [key if value is None else f"{key}:{value}" for key, value in pairs] or None


@dataclass(frozen=True, kw_only=True)
class Page(Resource):
    """A part of a list; ``next`` is where the following one begins."""

    items: list[Any]
    next: str | None = None


@dataclass(frozen=True, kw_only=True)
class SignedUrl(Resource):
    """An address that works without a key for a few minutes."""

    url: str


@dataclass(frozen=True, kw_only=True)
class JobKind(Resource):
    """A kind of job; ``reads`` names its inputs, ``options`` is the JSON Schema of its options."""

    kind: str
    title: str
    description: str
    reads: list[str] = field(default_factory=list)
    options: dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Upload(Resource):
    """A resumable upload: ``offset`` of ``size`` bytes have arrived."""

    id: str
    filename: str
    size: int
    offset: int
    sha256: str | None = None
    state: Literal["open", "complete"]


@dataclass(frozen=True, kw_only=True)
class Template(Resource):
    """A template anatomy; ``vertices`` are those of its skin, where they could be counted."""

    id: str
    name: str
    vertices: int | None = None
    sha256: str | None = None
    created_at: datetime | None = None


@dataclass(frozen=True, kw_only=True)
class Subject(Resource):
    """A person."""

    id: str
    name: str
    template_id: str | None = None
    labels: dict[str, str] = field(default_factory=dict)
    created_at: datetime | None = None
    retain_until: datetime | None = None


@dataclass(frozen=True, kw_only=True)
class Check(Resource):
    """The newest check of a scan: ``good``, ``usable`` or ``bad``."""

    job_id: str
    verdict: str


@dataclass(frozen=True, kw_only=True)
class Registration(Resource):
    """The newest registration of a raw scan; ``artifact_id`` is its mesh.

    An expression's was made from the registered neutral with ``neutral_sha256``.
    """

    job_id: str
    artifact_id: str
    sha256: str
    neutral_sha256: str | None = None


@dataclass(frozen=True, kw_only=True)
class Capture(Resource):
    """A named scan of a subject, ``registered`` or as the scanner made it.

    ``title`` is what people call it, at first as its file is called.
    """

    id: str
    name: FileName
    title: str = ""
    role: Role
    registered: bool = True
    labels: dict[str, str] = field(default_factory=dict)
    landmarks: str | None = None
    mask: str | None = None
    check: Check | None = None
    registration: Registration | None = None
    filename: str | None = None
    sha256: str | None = None
    created_at: datetime | None = None
    retain_until: datetime | None = None

    @property
    def registered_sha256(self) -> str | None:
        """The sha256 of its registered form as it is now; None: it has none."""
        if self.registered:
            return self.sha256
        return self.registration.sha256 if self.registration else None


@dataclass(frozen=True, kw_only=True)
class Artifact(Resource):
    """A file that the job ``job_id`` left; ``size`` in bytes, ``format`` a number if known."""

    id: str
    name: FileName
    size: int
    sha256: Sha256
    media_type: str
    job_id: str | None = None
    format: int | None = None


@dataclass(frozen=True, kw_only=True)
class FromJob(Resource):
    """A file that the ``job`` left, as an input of another; a scene has it by its ``name``."""

    job: str
    artifact: FileName
    name: str | None = None

    @classmethod
    def of(cls, artifact: Artifact, name: str | None = None) -> FromJob:
        """Return a job's file as an input."""
        if artifact.job_id is None:
            raise ValueError(f"{artifact.name} is of no job: take it out of a job's result")
        return cls(job=artifact.job_id, artifact=artifact.name, name=name)

    def to_dict(self) -> dict[str, str]:
        """Return it as a member of a request."""
        named = {} if self.name is None else {"name": self.name}
        return {"job": self.job, "artifact": self.artifact, **named}


def _once_each(artifacts: list[Artifact]) -> None:
    """Refuse files that a folder cannot hold: of one name, or of a device's on Windows."""
    if len({same_file(artifact.name) for artifact in artifacts}) < len(artifacts):
        raise ValueFaultError("two files have the same name")
    for artifact in artifacts:
        if is_device(artifact.name):
            raise ValueFaultError(f"{artifact.name!r} is a device's name on Windows")


Artifacts = Annotated[list[Artifact], _once_each]


@dataclass(frozen=True, kw_only=True)
class Progress(Resource):
    """Progress of a running job; ``fraction`` of the whole job in [0, 1]."""

    phase: str
    fraction: float
    iteration: int | None = None
    residual: float | None = None
    mean_error_mm: float | None = None
    message: str | None = None


@dataclass(frozen=True, kw_only=True)
class ResultItem(Resource):
    """Result of a succeeded job, in short."""

    rig_id: str | None = None
    verdict: str | None = None


@dataclass(frozen=True, kw_only=True)
class Result(ResultItem):
    """Result of a succeeded job; ``summary`` holds its verdict or figures."""

    summary: dict[str, Any] | None = None
    artifacts: Artifacts = field(default_factory=list)

    def __getitem__(self, name: str) -> Artifact:
        """Return the file of a name, which another job may read or `download` fetches."""
        for artifact in self.artifacts:
            if artifact.name == name:
                return artifact
        left = ", ".join(each.name for each in self.artifacts) or "nothing"
        raise KeyError(f"the job left no {name}: it left {left}")


@dataclass(frozen=True, kw_only=True)
class Cancel(Resource):
    """The order that stopped a job: by whom, and why."""

    by: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class JobItem(Resource):
    """A piece of work as lists show it; ``seconds`` is how long it took."""

    id: str
    subject_id: str
    subject_name: str = ""
    kind: str
    state: State
    priority: int = 0
    parent_id: str | None = None
    batch_id: str | None = None
    queue_position: int | None = None
    attempt: int
    last_event_id: int = 0
    progress: Progress | None = None
    error: dict[str, Any] | None = None
    result: ResultItem | None = None
    cancel: Cancel | None = None
    seconds: float | None = None
    created_at: datetime | None = None
    retain_until: datetime | None = None
    started_at: datetime | None = None
    finished_at: datetime | None = None


@dataclass(frozen=True, kw_only=True)
class Job(JobItem):
    """A piece of work."""

    result: Result | None = None


@dataclass(frozen=True, kw_only=True)
class LogLine(Resource):
    """A line that the solver printed in its ``attempt``; ``number`` counts over all attempts."""

    number: int
    attempt: int
    text: str


@dataclass(frozen=True, kw_only=True)
class LogPage(Resource):
    """Lines of a job's log."""

    lines: list[LogLine]


@dataclass(frozen=True, kw_only=True)
class FramePage(Resource):
    """Frames of a sequence, or of a simulation."""

    frames: list[dict[str, Any]]


@dataclass(frozen=True, kw_only=True)
class Frame(Resource):
    """A fitted frame of a sequence, see docs/guide/sequences.md; rad and mm."""

    frame: int
    status: Literal["fitted", "kept", "unseen", "predicted", "smoothed"]
    activations: list[list[float]]
    jaw: list[float]
    head: list[float]
    mean_mm: float | None
    p95_mm: float | None
    max_mm: float | None
    coverage: float
    inverted: int
    iterations: int
    seconds: float


@dataclass(frozen=True, kw_only=True)
class MotionFrame(Resource):
    """A frame of a simulation, see docs/guide/simulation.md; rad, mm and s."""

    frame: int
    time: float
    activations: list[list[float]]
    jaw: list[float]
    head: list[float]
    eyes: list[list[float]]
    penetration_mm: float
    behind_teeth: int
    inverted: int
    iterations: int
    halvings: int
    residual: float
    seconds: float


@dataclass(frozen=True, kw_only=True)
class RigItem(Resource):
    """A fitted face as lists show it; ``seconds`` is how long the job took that made it."""

    id: str
    name: str = ""
    subject_id: str
    subject_name: str = ""
    job_id: str | None = None
    parent_id: str | None = None
    expressions: list[str] = field(default_factory=list)
    labels: dict[str, str] = field(default_factory=dict)
    verdict: str | None = None
    mean_mm: float | None = None
    seconds: float | None = None
    created_at: datetime | None = None
    retain_until: datetime | None = None


@dataclass(frozen=True, kw_only=True)
class Rig(RigItem):
    """A fitted face."""

    summary: dict[str, Any] = field(default_factory=dict)
    artifacts: Artifacts = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class WholeRig(Rig):
    """A rig with its model's files and template among its ``artifacts``, and whose it is."""

    subject: Subject
    model_job_id: str | None = None


@dataclass(frozen=True, kw_only=True)
class BatchStep(Resource):
    """A job of a batch."""

    job_id: str
    state: State


@dataclass(frozen=True, kw_only=True)
class BatchCheck(BatchStep):
    """The check of a scan; ``verdict`` is ``good``, ``usable`` or ``bad`` when it is over."""

    verdict: str | None = None


@dataclass(frozen=True, kw_only=True)
class BatchFit(BatchStep):
    """The fit of a batch's expressions."""

    rig_id: str | None = None


@dataclass(frozen=True, kw_only=True)
class BatchScan(Resource):
    """A scan's way through a batch; ``left_out`` says why nothing more is made of it."""

    capture_id: str
    name: str
    role: Role
    check: BatchCheck | None = None
    registration: BatchStep | None = None
    left_out: str | None = None


@dataclass(frozen=True, kw_only=True)
class Batch(Resource):
    """All scans of a session: checked, and made into what was asked."""

    id: str
    name: str
    subject_id: str
    state: Literal["running", "succeeded", "failed", "canceled"]
    then: list[Then]
    scans: list[BatchScan]
    model: BatchStep | None = None
    fit: BatchFit | None = None
    error: dict[str, Any] | None = None
    cancel: Cancel | None = None
    created_at: datetime | None = None
    finished_at: datetime | None = None
