"""The database: sessions that read, sessions that write, and the schema brought up to date."""

from __future__ import annotations

import copy
import fcntl
import sqlite3
import time
import zlib
from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import (
    URL,
    Connection,
    Engine,
    create_engine,
    event,
    func,
    inspect,
    make_url,
    select,
    text,
)
from sqlalchemy.orm import Session

from service.queue.wakeups import WAKE, WakeUps
from service.store.files import files_at
from service.store.models import now
from service.store.tenancy import TENANT

if TYPE_CHECKING:
    from service.store.migrations.moves import Move

REVISIONS = Path(__file__).parent / "migrations" / "versions"
# FULL: what was acknowledged outlives a power cut, a deletion as well as an upload.
# secure_delete: what is deleted is overwritten, and does not stay in a free page
PRAGMAS = ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "secure_delete=ON")
# A table that is there while a restore into PostgreSQL is not finished
UNFINISHED = "myoface_restoring"
MIGRATION_LOCK = 0x6D796F  # any constant: PostgreSQL's advisory locks go by number


# Of a connection to PostgreSQL: a cut link is an error within seconds, not after a quarter hour.
# `tcp_user_timeout` is in milliseconds. What the URL says comes first.
PATIENCE = {
    "connect_timeout": 5,
    "tcp_user_timeout": 10_000,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
}


# Of a transaction that others wait for: no statement comes from its process for so long
MOST_IDLE_MS = 10_000

# Seconds for which a process that nobody waits for tries to begin a write
PATIENT = 30.0

# A request has a thread (40 at most) and briefly a second connection, for its key
POOL = {"pool_size": 10, "max_overflow": 40}


class NewerDatabaseError(Exception):
    """A newer release has changed the tables in ways that this one does not know."""


class UnfinishedRestoreError(Exception):
    """A restore was interrupted: what was deleted after the backup is there again."""


class Database:
    """An engine for SQLite (WAL) or PostgreSQL.

    On SQLite a writing session takes the write lock at its start (``BEGIN IMMEDIATE``): one that
    reads first and writes later would fail with "database is locked" without waiting.
    """

    def __init__(self, url: str) -> None:
        self.url = make_url(url)
        if self.is_sqlite and self.url.database:
            Path(self.url.database).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.engine = _engine(self.url, self.is_sqlite)

    @property
    def is_sqlite(self) -> bool:
        """Return whether this is SQLite."""
        return self.url.get_backend_name() == "sqlite"

    @contextmanager
    def read(self, tenant_id: str | None = None) -> Iterator[Session]:
        """Give a session for reading, a tenant's or the service's own."""
        info = {TENANT: tenant_id}
        with Session(self.engine, expire_on_commit=False, info=info) as session:
            yield session

    @contextmanager
    def write(self, tenant_id: str | None = None, patience: float = PATIENT) -> Iterator[Session]:
        """Give a session that commits at the end, or rolls back on an exception.

        ``patience`` are the seconds that it waits for a lock, on SQLite the one of all writers.
        """
        info = {TENANT: tenant_id}
        bind = self.engine.execution_options(patience=patience)
        with Session(bind, expire_on_commit=False, info=info) as session, session.begin():
            yield session

    def migrate(self, move: Move | None = None, revision: str = "head") -> None:
        """Bring the schema up to date; processes that start together wait for one another.

        ``move`` is Alembic's ``upgrade``, which is meant by None, or ``downgrade``.

        Raises
        ------
        NewerDatabaseError
            If the schema has a revision that this release does not have.
        """
        with self.engine.connect() as connection:
            if move is None and revision_of(connection) == known_revisions()[0]:
                return
        from service.store.migrations.moves import move_tables

        with self._one_at_a_time(), self._migrating() as connection:
            current = _refuse_newer(connection)
            move_tables(connection, move, revision, current, known_revisions())

    def refuse_unfinished(self) -> None:
        """Raise if a restore was interrupted.

        Raises
        ------
        UnfinishedRestoreError
            If it was: it must be done again before anybody sees what is there.
        """
        if inspect(self.engine).has_table(UNFINISHED):
            raise UnfinishedRestoreError("a restore was interrupted: run `myoface restore` again")

    @contextmanager
    def _migrating(self) -> Iterator[Connection]:
        """Give a connection that changes tables.

        SQLite changes a column by making the table anew, and dropping the old one would delete
        what refers to its rows.
        """
        with self.engine.connect() as connection:
            if not self.is_sqlite:
                yield connection
                return
            driver: Any = connection.connection.driver_connection
            driver.execute("PRAGMA foreign_keys=OFF")
            try:
                yield connection
            finally:
                connection.rollback()
                driver.execute("PRAGMA foreign_keys=ON")

    @contextmanager
    def _one_at_a_time(self) -> Iterator[None]:
        if self.is_sqlite:
            with open(f"{self.url.database}.migrate", "w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                yield
        else:
            with self.engine.connect() as connection:
                connection.execute(text("SELECT pg_advisory_lock(:n)"), {"n": MIGRATION_LOCK})
                try:
                    yield
                finally:
                    connection.execute(text("SELECT pg_advisory_unlock(:n)"), {"n": MIGRATION_LOCK})

    def forget_deleted(self) -> None:
        """Empty SQLite's write-ahead log, which still holds what was deleted.

        While somebody is reading, it only moves what it can: the next call does the rest.
        """
        if self.is_sqlite:
            # Of its own: with the patience of the others it would keep writers waiting as long.
            connection = sqlite3.connect(str(self.url.database), timeout=0.1)
            with closing(connection), suppress(sqlite3.OperationalError):
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def close(self) -> None:
        """Close the pooled connections."""
        self.engine.dispose()


def known_revisions() -> list[str]:
    """Return the revisions of the tables that this release has, the newest first."""
    names = (path.name.partition("_")[0] for path in REVISIONS.glob("[0-9]*.py"))
    return sorted(names, reverse=True)


def revision_of(connection: Connection) -> str | None:
    """Return the revision that the tables have; None: there are none."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    revision: str | None = connection.scalar(text("SELECT version_num FROM alembic_version"))
    return revision


def _refuse_newer(connection: Connection) -> str | None:
    """Return the revision of the tables, if this release knows it."""
    current = revision_of(connection)
    connection.rollback()  # else Alembic would take the transaction for its caller's
    if current is not None and current not in known_revisions():
        raise NewerDatabaseError(
            f"the database is of a newer release (revision {current}): start that release, "
            "or restore a backup of this one's"
        )
    return current


def clock(session: Session) -> datetime:
    """Return the moment by the database's clock: workers on several hosts must agree on leases."""
    if session.get_bind().dialect.name == "sqlite":
        return now()
    moment: datetime = session.execute(select(func.clock_timestamp())).scalar_one()
    return moment.astimezone(UTC)


def one_at_a_time(session: Session, name: str) -> None:
    """Let one transaction at a time go on from here, until it ends, of those that say this name.

    On SQLite writers are alone anyway. On PostgreSQL one whose process is frozen, or cut off, is
    ended by the server: nobody else would go on for hours.
    """
    if session.get_bind().dialect.name != "sqlite":
        session.execute(text(f"SET LOCAL idle_in_transaction_session_timeout = {MOST_IDLE_MS}"))
        number = zlib.crc32(name.encode())
        session.execute(select(func.pg_advisory_xact_lock(number)))


def _engine(url: URL, sqlite: bool) -> Engine:
    # hidden: names of people are among the parameters, and errors go to the log
    if not sqlite:
        patience = {name: value for name, value in PATIENCE.items() if name not in url.query}
        engine = create_engine(
            url, pool_pre_ping=True, hide_parameters=True, connect_args=patience, **POOL
        )
        event.listen(engine, "begin", _begin_postgresql)
        return engine
    threads = {"check_same_thread": False}
    engine = create_engine(url, hide_parameters=True, connect_args=threads, **POOL)
    event.listen(engine, "connect", _connect_sqlite)
    event.listen(engine, "begin", _begin_sqlite)
    return engine


def _connect_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # the driver must not begin transactions by itself
    for pragma in PRAGMAS:
        connection.execute(f"PRAGMA {pragma}")


def _begin_sqlite(connection: Connection) -> None:
    patience = connection.get_execution_options().get("patience")
    seconds = PATIENT if patience is None else patience
    connection.exec_driver_sql(f"PRAGMA busy_timeout={seconds * 1000:.0f}")
    connection.exec_driver_sql("BEGIN" if patience is None else "BEGIN IMMEDIATE")


def _begin_postgresql(connection: Connection) -> None:
    patience = connection.get_execution_options().get("patience")
    if patience is not None:  # 0 would be no limit
        connection.exec_driver_sql(f"SET LOCAL lock_timeout = {max(1, patience * 1000):.0f}")


class Store:
    """The data side: what a transaction wakes up is sent after its commit."""

    def __init__(self, database_url: str, files: Path | str, broker_url: str) -> None:
        self.database = Database(database_url)
        self.files = files_at(files)
        self._wake_ups = WakeUps(broker_url)
        self._tenant_id: str | None = None
        self._until: float | None = None

    def by(self, until: float) -> Store:
        """Return this store, whose writes begin by a moment of `time.monotonic` or not at all."""
        hasty = copy.copy(self)
        hasty._until = until
        return hasty

    def of(self, tenant_id: str) -> Store:
        """Return this store as a tenant sees it: its sessions find no other's rows."""
        seen = copy.copy(self)
        seen._tenant_id = tenant_id
        return seen

    def read(self) -> AbstractContextManager[Session]:
        """Give a session for reading."""
        return self.database.read(self._tenant_id)

    @contextmanager
    def write(self) -> Iterator[Session]:
        """Give a session that commits at the end; then send the wake-up calls asked for in it."""
        left = PATIENT if self._until is None else max(0.0, self._until - time.monotonic())
        with self.database.write(self._tenant_id, left) as session:
            yield session
        for job_id, queue in session.info.pop(WAKE, []):
            self._wake_ups.send(job_id, queue)

    def close(self) -> None:
        """Close the connections to broker and database."""
        self._wake_ups.close()
        self.database.close()
