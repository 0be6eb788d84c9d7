"""The tables of what was done: an audit log, answered requests, and receipts of deletions."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import ForeignKey, String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.models.base import Base, Owned, new_id, now


class AuditEntry(Owned, Base):
    """Who did what to which object: ids only, so that the log names nobody it outlives."""

    __tablename__ = "audit"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    created_at: Mapped[datetime] = mapped_column(default=now, index=True)
    key_id: Mapped[str] = mapped_column(String(12))
    request_id: Mapped[str] = mapped_column(String(64))
    action: Mapped[str] = mapped_column(String(64))
    object_id: Mapped[str] = mapped_column(String(36), index=True)


class AnsweredRequest(Owned, Base):
    """What a request with an ``Idempotency-Key`` made, so that its repetition finds it."""

    __tablename__ = "answered_requests"
    tenant_id: Mapped[str] = mapped_column(ForeignKey("tenants.id"), primary_key=True)
    key: Mapped[str] = mapped_column(String(255), primary_key=True)
    fingerprint: Mapped[str] = mapped_column(String(64))
    object_id: Mapped[str] = mapped_column(String(36))
    created_at: Mapped[datetime] = mapped_column(default=now, index=True)


class Deletion(Owned, Base):
    """The receipt of a deletion.

    ``rows_at``: when the object was gone from the tables (null: its jobs are being stopped).
    ``files_at``: when the last of ``files`` (sha256) that nothing else has was gone, too.
    """

    __tablename__ = "deletions"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    kind: Mapped[str] = mapped_column(String(16))
    object_id: Mapped[str] = mapped_column(String(36))
    reason: Mapped[str] = mapped_column(String(16))
    files: Mapped[list[Any]]
    created_at: Mapped[datetime] = mapped_column(default=now)
    rows_at: Mapped[datetime | None]
    files_at: Mapped[datetime | None] = mapped_column(index=True)
