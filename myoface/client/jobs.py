"""News of jobs and batches: server-sent events, watchers, and the errors of those that failed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from myoface.client.answers import read_data
from myoface.errors import ApiError
from myoface.resources import Artifact, Batch, Frame, FromJob, Job, MotionFrame

# Called with the job whenever its state or progress has changed.
Watcher = Callable[[Job], None]
# Called with the batch about once a second.
BatchWatcher = Callable[[Batch], None]


def unwatched(_job: Job, /) -> None:
    """Let a job run without looking."""


def unwatched_batch(_batch: Batch, /) -> None:
    """Let a batch run without looking."""


@dataclass(frozen=True)
class JobEvent:
    """News of a job."""

    kind: str
    data: dict[str, Any]


class EventReader:
    """Reads events out of a stream's bytes, in pieces that may end anywhere."""

    def __init__(self) -> None:
        self._rest = b""
        self._fields: dict[str, str] = {}

    def read(self, content: bytes) -> Iterator[JobEvent]:
        """Yield the events that are complete now."""
        *lines, self._rest = (self._rest + content).split(b"\n")
        for line in lines:
            text = line.decode(errors="replace").rstrip("\r")
            if text:
                name, _, value = text.partition(":")  # a comment has no name
                self._fields[name] = value.removeprefix(" ")
            else:
                fields = self._fields
                self._fields = {}
                if "event" in fields and "data" in fields:
                    yield JobEvent(fields["event"], read_data(fields["data"]))


def by_origin(captures: Iterable[str | Artifact | FromJob]) -> dict[str, list[Any]]:
    """Return what a job is to read as members of its request: captures, and files of jobs."""
    ids: list[str] = []
    left: list[dict[str, str]] = []
    for each in captures:
        if isinstance(each, str):
            ids.append(each)
        else:
            left.append((FromJob.of(each) if isinstance(each, Artifact) else each).to_dict())
    return {"captures": ids, "from_jobs": left}


def read_frame(values: dict[str, Any]) -> Frame | MotionFrame:
    """Return a frame of a sequence, or of a simulation: that one has no status."""
    return (Frame if "status" in values else MotionFrame).read(values)


def require_job(job: Job) -> Job:
    """Return a job that succeeded; raise the error of one that did not."""
    if job.state == "succeeded":
        return job
    why = f": {job.cancel.reason}" if job.cancel and job.cancel.reason else ""
    plain = {"code": f"job.{job.state}", "detail": f"{job.kind} job {job.id} was {job.state}{why}"}
    raise ApiError(job.error or plain)


def require_batch(batch: Batch) -> Batch:
    """Return a batch that succeeded; raise the error of one that did not."""
    if batch.state == "succeeded":
        return batch
    plain = {"code": f"batch.{batch.state}", "detail": f"batch {batch.id} was {batch.state}"}
    raise ApiError(batch.error or plain)
