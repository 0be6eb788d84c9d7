"""What the API says about the caller and its tenant."""

from __future__ import annotations

from pydantic import BaseModel, Field

from service.access.principal import Scope


class Me(BaseModel):
    """Whose key this is, and what it may be used for."""

    tenant: str
    key_id: str
    scopes: list[Scope]


class Use(BaseModel):
    """How much of something is in use; a limit that is null is none."""

    used: int
    limit: int | None


class Usage(BaseModel):
    """What a tenant uses."""

    bytes: Use = Field(
        description="scans, landmarks, templates, results, frames and open uploads; "
        "a file counts once"
    )
    queued: Use = Field(description="jobs that wait")
    running: Use = Field(description="jobs that a worker has; more wait in the queue")
