"""Database, files and queue together, as the API and the worker hold them."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from sqlalchemy.orm import Session

from service.store.database import Database
from service.store.files import files_at
from service.store.queue import WakeUps

WAKE = "wake"


class Store:
    """The data side: what a transaction wakes up is sent after its commit."""

    def __init__(self, database_url: str, files: Path | str, broker_url: str) -> None:
        self.database = Database(database_url)
        self.files = files_at(files)
        self._wake_ups = WakeUps(broker_url)
        self._tenant_id: str | None = None

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
        with self.database.write(self._tenant_id) as session:
            yield session
        for job_id, queue in session.info.pop(WAKE, []):
            self._wake_ups.send(job_id, queue)

    def close(self) -> None:
        """Close the connections to broker and database."""
        self._wake_ups.close()
        self.database.close()


def wake(session: Session, job_id: str, queue: str) -> None:
    """Ask for a wake-up call for a job after this session's commit."""
    session.info.setdefault(WAKE, []).append((job_id, queue))
