"""Move the tables from revision to revision, by Alembic.

A process whose tables are this release's does not import it: that is a tenth of its start.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection

from service.store.migrations.merging import TENANTS, refuse_merging

Move = Callable[[Config, str], None]


def move_tables(
    connection: Connection, move: Move | None, revision: str, current: str | None, known: list[str]
) -> None:
    """Move the tables to a revision, from the ``current`` one, by Alembic's upgrade or ``move``.

    ``known`` are this release's revisions, the newest first.
    """
    if move is command.downgrade and _is_before_tenants(current, revision, known):
        refuse_merging(connection)  # before the first step: SQLite takes none back
        connection.rollback()
    config = Config()
    config.set_main_option("script_location", str(Path(__file__).parent))
    config.attributes["connection"] = connection
    (move or command.upgrade)(config, revision)


def _is_before_tenants(current: str | None, revision: str, known: list[str]) -> bool:
    """Return whether tenants are lost on the way back to a revision; one step back says it."""
    ways = [*known, "base"]
    if current not in ways or revision not in ways:
        return False
    return TENANTS in ways[ways.index(current) : ways.index(revision)]
