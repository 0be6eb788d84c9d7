"""The scrubber: reads all stored files in turn, a few a minute, and notes which have rotted."""

from __future__ import annotations

import os
import secrets
import socket

from sqlalchemy import delete, func, select

from service.background import Background
from service.queue.sweep import hold_office
from service.settings import Settings
from service.store.database import Store
from service.store.deletion import REFERRING, referenced_files
from service.store.files import UnreachableError
from service.store.integrity import find_fault, note_fault
from service.store.models import FileFault

OFFICE = "scrubber"
MINUTE = 60.0


class Scrubber(Background):
    """Compares ``settings.scrub_per_minute`` files a minute with their names.

    One API process does it at a time, in the order of the names from a random one on, so that a
    service that is often started again reads not always the same files.
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        super().__init__("scrubber", MINUTE / settings.scrub_per_minute)
        self._store = store
        self._holder = f"{socket.gethostname()}:{os.getpid()}"
        self._last = secrets.token_hex(32)

    def _round(self) -> None:
        with self._store.write() as session:
            if not hold_office(session, OFFICE, self._holder, 3 * self._pause):
                return
        sha256 = self._next()
        if sha256 is None:
            self._last = ""
            self._forget_deleted()
            return
        before, self._last = self._last, sha256  # one that cannot be read keeps none from it
        try:
            fault = find_fault(self._store.files, sha256)
        except UnreachableError:
            self._last = before
            raise
        if fault is None or sha256 in referenced_files(self._store):  # not deleted meanwhile
            note_fault(self._store, sha256, fault)

    def _next(self) -> str | None:
        """Return the next file that rows refer to; None: that was the last one."""
        with self._store.read() as session:
            names = (
                session.scalar(select(func.min(column)).where(column > self._last))
                for column in REFERRING
            )
            return min(filter(None, names), default=None)

    def _forget_deleted(self) -> None:
        """Forget the faults of files that nothing refers to any more."""
        wanted = referenced_files(self._store)
        with self._store.write() as session:
            known = set(session.scalars(select(FileFault.sha256)))
            session.execute(delete(FileFault).where(FileFault.sha256.in_(known - wanted)))
