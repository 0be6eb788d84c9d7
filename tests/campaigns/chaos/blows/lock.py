"""The right to write, held by somebody else for longer than a lease."""

from __future__ import annotations

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager

from sqlalchemy import text

from service.store.database import Database
from tests.campaigns.chaos.stage import SETTINGS, Stage

LEASE = SETTINGS["lease"]


def hold_lock(stage: Stage) -> bool:
    """Let nobody write; reading must go on meanwhile."""
    if not stage.nobody_is_on_the_last_try():
        return False
    with _writing(stage.store.database):
        before = len(stage.reader.waits)
        time.sleep(LEASE * stage.dice.uniform(1.2, 2.0))
        return len(stage.reader.waits) > before


@contextmanager
def _writing(database: Database) -> Iterator[None]:
    """Hold what a writer holds: SQLite's one lock, PostgreSQL's on the jobs."""
    if database.is_sqlite:
        path = str(database.url.database)
        with closing(sqlite3.connect(path, timeout=30, isolation_level=None)) as connection:
            connection.execute("BEGIN IMMEDIATE")
            yield
            connection.execute("ROLLBACK")
        return
    with database.engine.connect() as server:
        server.execute(text("LOCK TABLE jobs, attempts, job_events IN EXCLUSIVE MODE"))
        yield
        server.rollback()
