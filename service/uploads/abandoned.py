"""Bytes of uploads that are over: each API process tidies its folder, which no worker may reach."""

from __future__ import annotations

import re
from datetime import timedelta
from pathlib import Path

import structlog

from service.background import Background
from service.settings import Settings
from service.store.models import now
from service.store.store import Store
from service.uploads import repository

PART = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
"""The name of an unfinished upload's file: its id."""
EVERY = 60.0

log = structlog.get_logger()


class Tidier(Background):
    """Removes the bytes of uploads that expired, or that a service which died left."""

    def __init__(self, store: Store, settings: Settings) -> None:
        super().__init__("uploads", min(EVERY, settings.garbage_age))
        self._store = store
        self._folder = settings.uploads
        self._age = timedelta(seconds=settings.garbage_age)

    def _round(self) -> None:
        # Listed before the table is read: the row of what is that old has long been committed.
        parts = _older(self._folder, (now() - self._age).timestamp())
        if not parts:
            return
        with self._store.read() as session:
            wanted = repository.unfinished(session)
        abandoned = [part for part in parts if part.name not in wanted]
        for part in abandoned:
            part.unlink(missing_ok=True)
        if abandoned:
            log.info("uploads.tidied", count=len(abandoned))


def _older(folder: Path, limit: float) -> list[Path]:
    """Return the unfinished uploads' files that nothing was written to since ``limit``."""
    found = []
    for path in folder.glob("*-*"):
        try:
            if PART.fullmatch(path.name) and path.stat().st_mtime < limit:
                found.append(path)
        except FileNotFoundError:  # completed or deleted meanwhile
            continue
    return found
