"""Typed values of the API's answers about a tenant: keys, limits, receipts, webhooks."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal

from myoface.values import Resource

Scope = Literal["read", "write", "delete", "webhooks", "metrics", "admin"]


@dataclass(frozen=True, kw_only=True)
class Me(Resource):
    """Owner and scopes of the client's key."""

    tenant: str
    key_id: str
    scopes: list[Scope]


@dataclass(frozen=True, kw_only=True)
class Use(Resource):
    """Amount in use; a ``limit`` of None is none."""

    used: int
    limit: int | None


@dataclass(frozen=True, kw_only=True)
class Limits(Resource):
    """Bounds of what a service accepts; ``builtin_vertices`` are a scan's without a template."""

    max_upload_bytes: int
    builtin_vertices: int | None = None


@dataclass(frozen=True, kw_only=True)
class Usage(Resource):
    """The tenant's stored bytes, its jobs that wait and run, and files that were lost."""

    bytes: Use
    queued: Use
    running: Use
    lost_files: int = 0


@dataclass(frozen=True, kw_only=True)
class Key(Resource):
    """An API key, without its text."""

    id: str
    name: str
    scopes: list[Scope]
    created_at: datetime
    expires_at: datetime | None = None
    last_used_at: datetime | None = None
    revoked_at: datetime | None = None


@dataclass(frozen=True, kw_only=True)
class NewKey(Key):
    """A key that was just made; its text is told once.

    It is None if the answer that told it was lost on the line: rotate the key then.
    """

    key: str | None = None


@dataclass(frozen=True, kw_only=True)
class Deletion(Resource):
    """The receipt of a deletion: when nothing showed the object, and when its files were gone.

    ``read_by`` are the newest jobs that stay and had read files of it.
    """

    id: str
    kind: str
    object_id: str
    reason: Literal["request", "retention"]
    created_at: datetime
    rows_at: datetime | None = None
    files_at: datetime | None = None
    read_by: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class AuditEntry(Resource):
    """An action with a key, and the object that it was done to."""

    id: str
    created_at: datetime
    key_id: str
    request_id: str
    action: str
    object_id: str


@dataclass(frozen=True, kw_only=True)
class Webhook(Resource):
    """An address that is told what happens; ``disabled_reason`` says why it is off."""

    id: str
    url: str
    events: list[str] = field(default_factory=list)
    kinds: list[str] = field(default_factory=list)
    active: bool
    disabled_reason: str | None = None
    failing_since: datetime | None = None
    rotated_at: datetime | None = None
    created_at: datetime | None = None


@dataclass(frozen=True, kw_only=True)
class NewWebhook(Webhook):
    """A webhook with the secret that its receiver verifies signatures by: told once.

    It is None if the answer that told it was lost on the line: rotate it then.
    """

    secret: str | None = None


@dataclass(frozen=True, kw_only=True)
class Delivery(Resource):
    """An event on its way, or what became of it; ``error`` is the code of what went wrong."""

    id: str
    webhook_id: str
    event_id: str
    type: str
    data: dict[str, Any]
    state: Literal["pending", "delivered", "failed"]
    attempt: int
    next_at: datetime | None = None
    status: int | None = None
    ms: int | None = None
    error: str | None = None
    excerpt: str | None = None
    created_at: datetime | None = None
    finished_at: datetime | None = None
