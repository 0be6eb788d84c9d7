"""Comparison of a database's tables with those that the models describe."""

from __future__ import annotations

from typing import Any

from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import Connection

from service.store.models import Base

# SQLite does not tell that it is descending; `test_backlogs.py` shows that it is
UNSEEN = {"sqlite": {"ix_jobs_claim"}}


def differences(connection: Connection) -> list[Any]:
    """Return what differs, as Alembic would write it into a migration."""
    unseen = UNSEEN.get(connection.dialect.name, set())
    context = MigrationContext.configure(
        connection, opts={"include_object": lambda _, name, *__: name not in unseen}
    )
    found: list[Any] = compare_metadata(context, Base.metadata)
    return found
