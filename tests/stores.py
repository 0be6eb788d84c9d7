"""Open a store of a test's own: its database with all tables, its files, a broker or none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from sqlalchemy import make_url

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
    """Begin a SQLite database that is not there yet with all tables, migrated once a process."""
    url = make_url(settings.database)
    if url.get_backend_name() == "sqlite" and url.database and not Path(url.database).exists():
        Path(url.database).parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        Path(url.database).write_bytes(_tables())


@cache
def _tables() -> bytes:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "tables.db"
        database = Database(f"sqlite:///{path}")
        database.migrate()
        database.engine.dispose()  # the last connection writes its log into the file
        return path.read_bytes()
