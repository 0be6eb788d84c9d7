"""Common parts of the tables."""

from __future__ import annotations

import uuid
from datetime import UTC, datetime
from typing import Any

from sqlalchemy import JSON, BigInteger, DateTime, Dialect, Enum, ForeignKey, String, TypeDecorator
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from service.queue.states import State


class UtcDateTime(TypeDecorator[datetime]):
    """A moment in UTC; SQLite would forget the zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Store UTC, without the zone where the database has none."""
        if value is None or dialect.name != "sqlite":
            return value
        return value.astimezone(UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime | None, _dialect: Dialect) -> datetime | None:
        """Read UTC."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


class Base(DeclarativeBase):
    """Base of every table."""

    type_annotation_map = {  # noqa: RUF012 (SQLAlchemy's own convention)
        datetime: UtcDateTime,
        dict[str, Any]: JSON(none_as_null=True),
        list[Any]: JSON,
        State: Enum(
            State,
            native_enum=False,
            length=16,
            values_callable=lambda states: [state.value for state in states],
        ),
    }


def new_id() -> str:
    """Return a random id."""
    return str(uuid.uuid4())


def now() -> datetime:
    """Return the moment, by this machine's clock."""
    return datetime.now(UTC)


class Stored:
    """A file in the content-addressed store: its user's name for it, size in bytes and sha256."""

    filename: Mapped[str] = mapped_column(String(255))
    size: Mapped[int] = mapped_column(BigInteger)
    sha256: Mapped[str] = mapped_column(String(64), index=True)


class Labelled:
    """A row with labels of its owner's, ``{key: value}``, by which lists can be filtered."""

    labels: Mapped[dict[str, Any]] = mapped_column(default=dict)


class Owned:
    """A row of one tenant's: other tenants' sessions do not see it (`service.store.tenancy`)."""

    tenant_id: Mapped[str] = mapped_column(ForeignKey("tenants.id"), index=True)
