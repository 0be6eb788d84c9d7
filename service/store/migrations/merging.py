"""Refuse to go back to releases that would give one tenant the people of another."""

from __future__ import annotations

from alembic.util import CommandError
from sqlalchemy import Connection, text

# The revision that brought tenants
TENANTS = "0004"


def refuse_merging(connection: Connection) -> None:
    """Raise if the database has several tenants, of whom a release before has no idea.

    Raises
    ------
    CommandError
        If there is more than one.
    """
    count = connection.execute(text("SELECT count(*) FROM tenants")).scalar_one()
    if count > 1:
        raise CommandError(
            f"the release before has no tenants, and this database has {count}, whose people "
            "would become one tenant's: remove the others, or restore a backup of that release"
        )
