"""Views of the service itself."""

from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, Field

from service.schemas import View
from solver.kinds import FILES, Kind, Role


class Retention(BaseModel):
    """Days that things are kept; null: until somebody deletes them."""

    subjects: int | None
    scans: int | None
    jobs: int | None
    rigs: int | None
    audit: int | None


class RoleView(View):
    """A role of captures, and the endings of its files."""

    role: str
    title: str
    noun: str
    then: str = Field(description="what becomes of such a file, in words")
    is_scan: bool = Field(description="whether it is checked and registered")
    formats: list[str]
    own_formats: list[str] = Field(
        description="of these, those that no other role has: such a file is of this role"
    )
    landmarks: list[str] = Field(
        description="endings of the file beside one: landmarks, of a photograph what is known of it"
    )
    masks: list[str] = Field(description="endings of the mask beside one, if it takes one")
    sets: list[str] = Field(
        description="of what lies beside such files for all of a session, a marker set"
    )

    @classmethod
    def of(cls, name: str, role: Role) -> RoleView:
        """Show a role."""
        return cls.model_validate({"role": name, "is_scan": role.is_scan, **asdict(role)})


class Limits(BaseModel):
    """Limits on what this service accepts, and how long it keeps things (bytes, seconds)."""

    max_upload_bytes: int
    upload_ttl: float
    rate_per_minute: int = Field(description="requests of a key")
    retention: Retention
    scan_formats: list[str]
    raw_scan_formats: list[str]
    landmark_formats: list[str]
    roles: list[RoleView] = Field(description="that captures have")
    builtin_vertices: int = Field(
        description="of a registered scan of a subject without a template, the built-in face's"
    )
    max_attempts: int


class KindView(View):
    """A kind of job; `options` is a JSON Schema."""

    kind: str
    title: str
    description: str
    queue: str
    reads: list[str]
    leaves: str
    hands_on: dict[str, str] = Field(
        description="files it leaves that later jobs may be told to read by `from_jobs`, and the "
        "input that each is: of kinds that have it in `reads`"
    )
    options: dict[str, Any]
    frames: bool = Field(description="whether it leaves frames, which can be read while it runs")
    max_seconds: int = Field(description="after which an attempt at it is ended")

    @classmethod
    def of(cls, kind: Kind, max_seconds: int) -> KindView:
        """Show a kind of job."""
        return cls(
            kind=kind.name,
            title=kind.title,
            description=kind.description,
            queue=kind.queue,
            reads=list(kind.reads),
            leaves=kind.leaves,
            hands_on={name: FILES[name].input for name in kind.hands_on},
            options=kind.schema,
            frames=kind.frames,
            max_seconds=max_seconds,
        )


class WorkerView(View):
    """A living worker."""

    name: str
    queue: str
    host: str
    version: str
    kinds: list[str] = Field(description="the kinds of job that it does")
    lacks: list[str] | None = Field(
        description="what is missing of finding faces in pictures: `av`, `mediapipe`, `landmarker`"
    )
    memory_mb: int = Field(description="memory that each of its jobs may take")
    threads: int = Field(description="threads of each of its jobs")
    slots: int = Field(description="jobs at a time")
    started_at: datetime
    seen_at: datetime


SweeperState = Literal["ok", "silent", "unknown"]


class Readiness(BaseModel):
    """Readiness of the parts.

    Without a worker jobs wait, and without a sweeper what was lost waits for its repair, expired
    things and deleted files for their end: neither gets better by sending requests elsewhere, so
    both are told beside `ready`.
    """

    ready: bool
    checks: dict[str, Literal["ok", "failed"]]
    workers: dict[str, int] = Field(description="how many live, by queue")
    sweeper: SweeperState = Field(
        description="`silent`: for a minute no worker has repaired and tidied up; "
        "`unknown`: the database does not answer"
    )
