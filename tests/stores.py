"""Open a store of a test's own: its database with all tables, its files, a broker or none."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import psycopg
from sqlalchemy import URL, make_url

from service.settings import Settings
from service.store.database import Database, Store


@contextmanager
def open_store(folder: Path, *, broker: str | None = None) -> Iterator[Store]:
    """Yield a store in a folder, closed at the end; without ``broker`` nobody listens there."""
    settings = Settings(data_dir=folder)
    lay_tables(settings)
    store = Store(settings.database, settings.files, broker or f"redis+socket://{folder}/nobody")
    store.database.migrate()
    try:
        yield store
    finally:
        store.close()


def lay_tables(settings: Settings) -> None:
    """Begin a database that has none yet with all tables, migrated once a process."""
    url = make_url(settings.database)
    if url.get_backend_name() != "sqlite":
        _copy_tables(url)
    elif url.database and not Path(url.database).exists():
        Path(url.database).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        Path(url.database).write_bytes(_tables())


@cache
def _tables() -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "tables.db"
        _migrate(f"sqlite:///{path}")  # the last connection writes its log into the file
        return path.read_bytes()


def _copy_tables(url: URL) -> None:
    """Put a copy of a migrated PostgreSQL database into the place of an empty one."""
    with _connected(url) as connection:
        found = connection.execute("SELECT to_regclass('alembic_version')").fetchone()
    if found == (None,):
        server = url.set(database="postgres")
        migrated = _migrated(server)
        with _connected(server) as connection:
            connection.execute(f"DROP DATABASE {url.database}")
            connection.execute(f"CREATE DATABASE {url.database} TEMPLATE {migrated}")


@cache
def _migrated(server: URL) -> str:
    """Return the name of a database with all tables on a PostgreSQL server."""
    name = f"tables_{uuid.uuid4().hex[:12]}"
    with _connected(server) as connection:
        connection.execute(f"CREATE DATABASE {name}")
    _migrate(server.set(database=name).render_as_string(hide_password=False))
    return name


def _migrate(url: str) -> None:
    database = Database(url)
    database.migrate()
    database.close()


def _connected(url: URL) -> psycopg.Connection:
    return psycopg.connect(
        host=url.host,
        port=url.port,
        user=url.username,
        password=url.password,
        dbname=url.database,
        autocommit=True,
        connect_timeout=60,
    )
