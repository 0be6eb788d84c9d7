"""The tables of who may do what: tenants and their API keys."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import BigInteger, String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.models.base import Base, Owned, new_id, now

DEFAULT_TENANT = "default"
"""The tenant that every installation has: a studio of its own needs no other."""


class Tenant(Base):
    """A customer, who sees nothing of the others.

    A quota that is null sets no limit; days of retention that are null are the installation's.
    """

    __tablename__ = "tenants"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200))
    max_bytes: Mapped[int | None] = mapped_column(BigInteger)
    max_queued: Mapped[int | None]
    max_running: Mapped[int | None]
    retain_subjects: Mapped[int | None]
    retain_scans: Mapped[int | None]
    retain_jobs: Mapped[int | None]
    retain_rigs: Mapped[int | None]
    created_at: Mapped[datetime] = mapped_column(default=now)


class ApiKey(Owned, Base):
    """A key of a tenant; its text is told once and kept only as a keyed hash."""

    __tablename__ = "api_keys"
    id: Mapped[str] = mapped_column(String(12), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    hash: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[Any]]
    created_at: Mapped[datetime] = mapped_column(default=now)
    expires_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]
