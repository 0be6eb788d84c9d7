"""The tables of the workers themselves."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import String
from sqlalchemy.orm import Mapped, mapped_column

from service.store.models.base import Base, now


class Worker(Base):
    """A living worker process and what it can do: ``slots`` jobs of ``kinds`` at a time.

    Each job may take ``memory_mb`` and has ``threads``.
    """

    __tablename__ = "workers"
    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    queue: Mapped[str] = mapped_column(String(16))
    host: Mapped[str] = mapped_column(String(255), default="")
    version: Mapped[str] = mapped_column(String(32), default="")
    kinds: Mapped[list[Any]] = mapped_column(default=list)
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
