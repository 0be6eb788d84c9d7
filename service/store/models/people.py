"""The tables of what studios bring: uploads, templates, subjects and their captures."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import BigInteger, ForeignKey, String, UniqueConstraint
from sqlalchemy.orm import Mapped, mapped_column

from service.store.models.base import Base, Owned, Stored, new_id, now


class Upload(Owned, Base):
    """A resumable upload; ``offset`` bytes have been received and counted.

    ``used_by`` is the id of the capture or template that it was last used for, and goes with.
    """

    __tablename__ = "uploads"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    filename: Mapped[str] = mapped_column(String(255))
    size: Mapped[int] = mapped_column(BigInteger)
    offset: Mapped[int] = mapped_column(BigInteger, default=0)
    sha256: Mapped[str | None] = mapped_column(String(64), index=True)
    complete: Mapped[bool] = mapped_column(default=False)
    used_by: Mapped[str | None] = mapped_column(String(36), index=True)
    created_at: Mapped[datetime] = mapped_column(default=now)
    expires_at: Mapped[datetime] = mapped_column(index=True)


class Template(Stored, Owned, Base):
    """A template anatomy."""

    __tablename__ = "templates"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200))
    created_at: Mapped[datetime] = mapped_column(default=now)


class Subject(Owned, Base):
    """A person."""

    __tablename__ = "subjects"
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    name: Mapped[str] = mapped_column(String(200))
    template_id: Mapped[str | None] = mapped_column(ForeignKey("templates.id"))
    created_at: Mapped[datetime] = mapped_column(default=now)


class Capture(Stored, Owned, Base):
    """A named scan of a subject: registered, or raw as the scanner made it."""

    __tablename__ = "captures"
    __table_args__ = (UniqueConstraint("subject_id", "name"),)
    id: Mapped[str] = mapped_column(String(36), primary_key=True, default=new_id)
    subject_id: Mapped[str] = mapped_column(
        ForeignKey("subjects.id", ondelete="CASCADE"), index=True
    )
    name: Mapped[str] = mapped_column(String(64))
    role: Mapped[str] = mapped_column(String(16))
    registered: Mapped[bool] = mapped_column(default=True)
    landmarks_filename: Mapped[str | None] = mapped_column(String(255))
    landmarks_size: Mapped[int | None] = mapped_column(BigInteger)
    landmarks_sha256: Mapped[str | None] = mapped_column(String(64), index=True)
    created_at: Mapped[datetime] = mapped_column(default=now)

    @property
    def uploaded(self) -> list[str]:
        """The sha256 of the files that were uploaded for it."""
        return list(filter(None, (self.sha256, self.landmarks_sha256)))
