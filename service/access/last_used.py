"""Last use of keys, written down beside the requests: reading needs no write."""

from __future__ import annotations

import threading
from datetime import datetime

from sqlalchemy import update

from service.background import Background
from service.store.database import Store
from service.store.models import ApiKey

EVERY = 1.0


class LastUses(Background):
    """Write down, best effort, when keys were last used.

    A database that is full or busy costs a note, never a request: the key's next use makes another.
    """

    def __init__(self, store: Store) -> None:
        super().__init__("last-uses", EVERY)
        self._store = store
        self._noted: dict[str, datetime] = {}
        self._lock = threading.Lock()

    def note(self, key_id: str, moment: datetime) -> None:
        """Remember that a key was used."""
        with self._lock:
            self._noted[key_id] = moment

    def _round(self) -> None:
        with self._lock:
            noted, self._noted = self._noted, {}
        if not noted:
            return
        with self._store.write() as session:
            for key_id, moment in noted.items():
                changed = update(ApiKey).where(ApiKey.id == key_id).values(last_used_at=moment)
                session.execute(changed)
