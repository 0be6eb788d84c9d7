"""Bodies and views of live sessions."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field

from service.jobs.schemas import FromJob, JobError
from service.queue.states import State
from service.schemas import Id, RequestBody, View
from service.store.models import Job
from solver.kinds.live_session import LiveSessionOptions, Source


class NewSession(RequestBody):
    """A session to be opened."""

    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [{"rig_id": "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11", "source": "weights"}]
        },
    )

    rig_id: Id
    source: Source = Field(default="weights", description="what the frames are")
    captures: list[Id] = Field(
        default=[], max_length=1, description="id of the capture that is the session's marker set"
    )
    from_jobs: list[FromJob] = Field(
        default=[],
        max_length=8,
        description="files that earlier jobs left: a check's `markers.json`, a basis, controls",
    )
    options: dict[str, Any] = Field(
        default={}, description="further options of `live_session`, as `GET /v1/kinds` has them"
    )


class TicketOrder(RequestBody):
    """A ticket that is asked for."""

    watch: bool = Field(
        default=False, description="for a connection that only sees; the scope `read` is enough"
    )


class TakeRecording(RequestBody):
    """A take that is to be recorded."""

    name: str = Field(
        min_length=1, max_length=80, description="of the take; its file is called after it"
    )


class TicketView(BaseModel):
    """A ticket: it opens one connection, once, until ``expires_at``."""

    ticket: str
    url: str = Field(
        description="of the WebSocket, relative to the service's",
        examples=["/v1/live/4d8e0f9a-.../frames?ticket=s.Qk3..."],
    )
    expires_at: datetime


class SessionView(View):
    """A live session; the job of the same id has its options, log, figures and takes."""

    id: str
    subject_id: str
    rig_id: str
    source: str
    state: State = Field(description="the job's: it is `running` once a worker has it")
    attempt: int = Field(description="of workers at it: one that was lost is followed by another")
    error: JobError | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None

    @classmethod
    def of(cls, job: Job) -> Self:
        """Show a session."""
        shown = {name: getattr(job, name, None) for name in cls.model_fields}
        options = LiveSessionOptions.model_validate(job.request["options"])
        request = {"rig_id": job.request["rig_id"], "source": options.source}
        return cls.model_validate({**shown, **request})


class OpenedSession(SessionView, TicketView):
    """A session and the ticket of its station."""
