"""Open a store of a test's own: its database with all tables, its files, a broker or none."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.settings import Settings
from service.store.database import Store


@contextmanager
def open_store(folder: Path, *, broker: str | None = None) -> Iterator[Store]:
    """Yield a store in a folder, closed at the end; without ``broker`` nobody listens there."""
    settings = Settings(data_dir=folder)
    store = Store(settings.database, settings.files, broker or f"redis+socket://{folder}/nobody")
    store.database.migrate()
    try:
        yield store
    finally:
        store.close()
