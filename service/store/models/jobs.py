"""Tables of the work: jobs and what they leave, batches, workers and offices."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import (
    BigInteger,
    ColumnElement,
    ForeignKey,
    Index,
    Integer,
    Select,
    SmallInteger,
    String,
    Text,
    UniqueConstraint,
    and_,
    func,
    select,
    text,
)
from sqlalchemy.orm import (
    InstrumentedAttribute,
    Mapped,
    column_property,
    mapped_column,
    relationship,
)

from service import tracing
from service.queue.states import State
from service.store.models.base import Base, Labelled, Owned, new_id, now

PREVIEW = "build_preview"
PREVIEW_FILE = "preview.bin"


class Event(Base):
    """Event of a job for its watchers; the id is the server-sent event's id."""

    __tablename__ = "job_events"
    __table_args__ = (Index("ix_job_events_job_id", "job_id", "id"),)
    id: Mapped[int] = mapped_column(
        BigInteger().with_variant(Integer, "sqlite"), primary_key=True, autoincrement=True
    )
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    kind: Mapped[str] = mapped_column(String(16))
    data: Mapped[dict[str, Any]]
    created_at: Mapped[datetime] = mapped_column(default=now)


class Job(Owned, Base):
    """A piece of work. ``inputs`` fixes at submission which files it reads.

    One about a single capture has its ``capture_id`` and is deleted with it. ``attempt`` is the
    fence of the present holder; ``lost`` counts the attempts that came to nothing, of which
    ``max_attempts`` are too many.
    """

    __tablename__ = "jobs"
    __table_args__ = (
        # a claim reads a tenant's first jobs of a queue, in the order of `claims.own_order`
        Index(
            "ix_jobs_claim",
            *("queue", "state", "tenant_id", text("priority DESC"), "created_at", "id"),
        ),
    )
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    subject_id: Mapped[str] = mapped_column(
        ForeignKey("subjects.id", ondelete="CASCADE"), index=True
    )
    kind: Mapped[str] = mapped_column(String(32))
    queue: Mapped[str] = mapped_column(String(16))
    request: Mapped[dict[str, Any]]
    inputs: Mapped[list[Any]]
    model_job_id: Mapped[str | None] = mapped_column(String(36))
    capture_id: Mapped[str | None] = mapped_column(String(36), index=True)
    parent_id: Mapped[str | None] = mapped_column(String(36), index=True)
    batch_id: Mapped[str | None] = mapped_column(String(36), index=True)
    priority: Mapped[int] = mapped_column(SmallInteger, default=0)
    memory_mb: Mapped[int | None]

    state: Mapped[State] = mapped_column(default=State.QUEUED)
    attempt: Mapped[int] = mapped_column(default=0)
    lost: Mapped[int] = mapped_column(default=0)
    max_attempts: Mapped[int]
    not_before: Mapped[datetime | None]
    no_room_since: Mapped[datetime | None]
    lease_owner: Mapped[str | None] = mapped_column(String(100))
    leased_at: Mapped[datetime | None]
    lease_until: Mapped[datetime | None]
    sends: Mapped[int] = mapped_column(default=0)
    sent_at: Mapped[datetime | None]
    traceparent: Mapped[str | None] = mapped_column(
        String(tracing.LONGEST), default=tracing.traceparent
    )

    progress: Mapped[dict[str, Any] | None]
    error: Mapped[dict[str, Any] | None]
    summary: Mapped[dict[str, Any] | None]
    cancel: Mapped[dict[str, Any] | None]
    created_at: Mapped[datetime] = mapped_column(default=now)
    started_at: Mapped[datetime | None]
    finished_at: Mapped[datetime | None]

    attempts: Mapped[list[Attempt]] = relationship(order_by="Attempt.number", viewonly=True)
    artifacts: Mapped[list[Artifact]] = relationship(order_by="Artifact.name", viewonly=True)
    rig: Mapped[Rig | None] = relationship(viewonly=True)
    last_event_id: Mapped[int] = column_property(
        select(func.max(Event.id)).where(Event.job_id == id).scalar_subquery(), deferred=True
    )

    @property
    def seconds(self) -> float | None:
        """Seconds that it took, waits between attempts among them; None: it has not ended."""
        if self.started_at is None or self.finished_at is None:
            return None
        return (self.finished_at - self.started_at).total_seconds()


class Attempt(Base):
    """One claim of a job by a worker."""

    __tablename__ = "attempts"
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True)
    worker: Mapped[str] = mapped_column(String(100))
    started_at: Mapped[datetime]
    finished_at: Mapped[datetime | None]
    outcome: Mapped[str | None] = mapped_column(String(16))


class LogLine(Base):
    """A line that a solver printed; ``number`` counts over all attempts from 1."""

    __tablename__ = "job_log"
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    number: Mapped[int] = mapped_column(BigInteger, primary_key=True)
    attempt: Mapped[int]
    text: Mapped[str] = mapped_column(Text)


class Rig(Labelled, Owned, Base):
    """A fitted face: the result of a ``fit_*`` job; ``name`` is empty until it is given one."""

    __tablename__ = "rigs"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    subject_id: Mapped[str] = mapped_column(
        ForeignKey("subjects.id", ondelete="CASCADE"), index=True
    )
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), unique=True)
    model_job_id: Mapped[str] = mapped_column(String(36))
    parent_id: Mapped[str | None] = mapped_column(ForeignKey("rigs.id", ondelete="SET NULL"))
    name: Mapped[str] = mapped_column(String(200), default="")
    expressions: Mapped[list[Any]]
    summary: Mapped[dict[str, Any]]
    created_at: Mapped[datetime] = mapped_column(default=now)

    artifacts: Mapped[list[Artifact]] = relationship(
        primaryjoin="foreign(Artifact.job_id) == Rig.job_id",
        order_by="Artifact.name",
        viewonly=True,
    )


class Artifact(Owned, Base):
    """A file that a job left; of one that later jobs read, the number of its ``format``."""

    __tablename__ = "artifacts"
    __table_args__ = (UniqueConstraint("job_id", "name"),)
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"))
    name: Mapped[str] = mapped_column(String(255))
    size: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64), index=True)
    media_type: Mapped[str] = mapped_column(String(100))
    format: Mapped[int | None]
    created_at: Mapped[datetime] = mapped_column(default=now)


class FrameChunk(Base):
    """Frames of a sequence, ready while its job runs: the ``first`` to the ``last``, from 0."""

    __tablename__ = "job_frames"
    job_id: Mapped[str] = mapped_column(ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    first: Mapped[int] = mapped_column(primary_key=True)
    last: Mapped[int]
    attempt: Mapped[int]
    size: Mapped[int | None] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64), index=True)

    @property
    def filename(self) -> str:
        """The name of the solver's file of these frames."""
        return f"{self.first:06d}-{self.last:06d}.json"


class Batch(Owned, Base):
    """A session's scans: ``state`` is running, succeeded, failed or canceled."""

    __tablename__ = "batches"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    subject_id: Mapped[str] = mapped_column(
        ForeignKey("subjects.id", ondelete="CASCADE"), index=True
    )
    name: Mapped[str] = mapped_column(String(200))
    capture_ids: Mapped[list[Any]]
    steps: Mapped[list[Any]]
    options: Mapped[dict[str, Any]]
    priority: Mapped[int] = mapped_column(default=0)
    state: Mapped[str] = mapped_column(String(16), default="running", index=True)
    error: Mapped[dict[str, Any] | None]
    cancel: Mapped[dict[str, Any] | None]
    created_at: Mapped[datetime] = mapped_column(default=now)
    finished_at: Mapped[datetime | None]


class Worker(Base):
    """A living worker process and what it can do: ``slots`` jobs of ``kinds`` at a time.

    Each job may take ``memory_mb`` and has ``threads``. ``lacks`` has what is missing of finding
    faces in pictures: ``av``, ``mediapipe``, ``landmarker``; None: its release does not say.
    """

    __tablename__ = "workers"
    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    queue: Mapped[str] = mapped_column(String(16))
    host: Mapped[str] = mapped_column(String(255), default="")
    version: Mapped[str] = mapped_column(String(32), default="")
    kinds: Mapped[list[Any]] = mapped_column(default=list)
    lacks: Mapped[list[Any] | None]
    memory_mb: Mapped[int] = mapped_column(default=0)
    threads: Mapped[int] = mapped_column(default=0)
    slots: Mapped[int] = mapped_column(default=0)
    started_at: Mapped[datetime] = mapped_column(default=now)
    seen_at: Mapped[datetime] = mapped_column(default=now)


class Lease(Base):
    """An office that one process holds at a time: the sweeper, the one who advances batches."""

    __tablename__ = "leases"
    office: Mapped[str] = mapped_column(String(32), primary_key=True)
    holder: Mapped[str] = mapped_column(String(100))
    until: Mapped[datetime]


def is_preview_of(rig_id: str | InstrumentedAttribute[str]) -> ColumnElement[bool]:
    """Select the jobs that make a rig's preview, which stays and goes with the rig."""
    return and_(Job.kind == PREVIEW, Job.request["rig_id"].as_string() == rig_id)


def is_preview_of_any(rig_ids: Select[tuple[str]]) -> ColumnElement[bool]:
    """Select the jobs that make the preview of one of some rigs."""
    return and_(Job.kind == PREVIEW, Job.request["rig_id"].as_string().in_(rig_ids))
