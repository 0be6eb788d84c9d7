"""Tables of tenants with their keys, uploads, templates, subjects and captures."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import BigInteger, ForeignKey, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from service.store.models.base import Base, Labelled, Owned, Stored, new_id, now

# The tenant that every installation has: a studio of its own needs no other
DEFAULT_TENANT = "default"


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
    """A key of a tenant; its text is shown once and kept only as a keyed hash."""

    __tablename__ = "api_keys"
    id: Mapped[str] = mapped_column(String(12), primary_key=True)
    name: Mapped[str] = mapped_column(String(200))
    hash: Mapped[str] = mapped_column(String(64))
    scopes: Mapped[list[Any]]
    created_at: Mapped[datetime] = mapped_column(default=now)
    expires_at: Mapped[datetime | None]
    last_used_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]


class Upload(Owned, Base):
    """A resumable upload; ``offset`` bytes have been received and counted.

    ``used_by`` is the id of the capture or template that it was last used for, and goes with.
    ``sent_sha256`` is that of the bytes as they came, once all have: of photographs others are
    stored.
    """

    __tablename__ = "uploads"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    filename: Mapped[str] = mapped_column(String(255))
    size: Mapped[int] = mapped_column(BigInteger)
    offset: Mapped[int] = mapped_column(BigInteger, default=0)
    sha256: Mapped[str | None] = mapped_column(String(64), index=True)
    sent_sha256: Mapped[str | None] = mapped_column(String(64))
    complete: Mapped[bool] = mapped_column(default=False)
    used_by: Mapped[str | None] = mapped_column(String(36), index=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    expires_at: Mapped[datetime] = mapped_column(index=True)


class Template(Stored, Owned, Base):
    """A template anatomy; ``vertices`` of its skin are null where they could not be counted."""

    __tablename__ = "templates"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200))
    vertices: Mapped[int | None]
    created_at: Mapped[datetime] = mapped_column(default=now)


class Subject(Labelled, Owned, Base):
    """A person."""

    __tablename__ = "subjects"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200))
    template_id: Mapped[str | None] = mapped_column(ForeignKey("templates.id"))
    created_at: Mapped[datetime] = mapped_column(default=now)


class Capture(Labelled, Stored, Owned, Base):
    """A named scan of a subject: registered, or raw as the scanner made it.

    ``title`` is what people call it; null is what its file is called. ``sent_sha256`` is that of
    the file as it was sent, null of those that were sent before it was kept.
    """

    __tablename__ = "captures"
    __table_args__ = (UniqueConstraint("subject_id", "name"),)
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    subject_id: Mapped[str] = mapped_column(
        ForeignKey("subjects.id", ondelete="CASCADE"), index=True
    )
    name: Mapped[str] = mapped_column(String(64))
    title: Mapped[str | None] = mapped_column(String(200))
    role: Mapped[str] = mapped_column(String(16))
    registered: Mapped[bool] = mapped_column(default=True)
    landmarks_filename: Mapped[str | None] = mapped_column(String(255))
    landmarks_size: Mapped[int | None] = mapped_column(BigInteger)
    landmarks_sha256: Mapped[str | None] = mapped_column(String(64), index=True)
    mask_filename: Mapped[str | None] = mapped_column(String(255))
    mask_size: Mapped[int | None] = mapped_column(BigInteger)
    mask_sha256: Mapped[str | None] = mapped_column(String(64), index=True)
    sent_sha256: Mapped[str | None] = mapped_column(String(64))
    created_at: Mapped[datetime] = mapped_column(default=now)

    @property
    def uploaded_files(self) -> list[str]:
        """The sha256 of the files that were uploaded for it."""
        return list(filter(None, (self.sha256, self.landmarks_sha256, self.mask_sha256)))
