"""Bodies and views of API keys, of the caller and its tenant."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import BaseModel, Field, StringConstraints

from service.access.principal import Scope
from service.schemas import Moment, RequestBody, Title, View

KEY_ID = r"^[0-9A-Za-z]{12}$"
LONGEST_GRACE = 30 * 24 * 3600
DAY = 24 * 3600

KeyId = Annotated[str, StringConstraints(pattern=KEY_ID)]


class NewKey(RequestBody):
    """A key for a person or a machine."""

    name: Title = Field(examples=["capture station 2"])
    scopes: list[Scope] = Field(min_length=1, max_length=len(Scope), examples=[["read", "write"]])
    expires_at: Moment | None = Field(default=None, description="default: never")


class Rotation(RequestBody):
    """Order to replace a key."""

    grace: int = Field(
        default=DAY, ge=0, le=LONGEST_GRACE, description="seconds that the old one goes on to work"
    )


class KeyView(View):
    """A key, without its text."""

    id: str
    name: str
    scopes: list[Scope]
    created_at: datetime
    expires_at: datetime | None
    last_used_at: datetime | None = Field(description="to the minute")
    revoked_at: datetime | None


class KeyWithText(KeyView):
    """A key that was just made; `key` is its text, which is told in this answer only."""

    key: str | None = Field(description="null: the request was a repetition of an answered one")


class Me(BaseModel):
    """Owner and scopes of the caller's key."""

    tenant: str
    key_id: str
    scopes: list[Scope]


class Use(BaseModel):
    """Amount in use; a limit that is null is none."""

    used: int
    limit: int | None


class Usage(BaseModel):
    """Usage and quotas of a tenant."""

    bytes: Use = Field(
        description="scans, landmarks, templates, results, frames and open uploads; "
        "a file counts once"
    )
    queued: Use = Field(description="jobs that wait")
    running: Use = Field(description="jobs that a worker has; more wait in the queue")
    lost_files: int = Field(description="files that the service has lost or damaged")
