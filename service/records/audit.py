"""Writing the audit log: what was done, in its own transaction, and what was read."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from contextlib import suppress
from datetime import datetime

import structlog
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.access.principal import Principal
from service.background import Background
from service.store.database import Store, clock
from service.store.models import AuditEntry, now

EVERY = 1.0
# Seconds for which further reads of the same by the same key are not noted
ONCE_IN = 3600.0
# Reads that are remembered as noted, and those that wait for a database that takes nothing
MOST_KNOWN = 100_000
MOST_WAITING = 10_000

log = structlog.get_logger()


def record(session: Session, who: Principal, action: str, object_id: str) -> None:
    """Write down that ``who`` did ``action``, in the transaction of what was done.

    Ids only: the log outlives the people it is about, and must not keep their names.
    """
    session.add(AuditEntry(**_entry(who, action, object_id, clock(session))))


def _entry(who: Principal, action: str, object_id: str, moment: datetime) -> dict[str, object]:
    return {
        "tenant_id": who.tenant_id,
        "key_id": who.key_id,
        "request_id": who.request_id,
        "action": action,
        "object_id": object_id,
        "created_at": moment,
    }


class ReadLog(Background):
    """Notes what is read, and writes it to the audit log every second in one transaction.

    Faces are biometric data, and whoever took a file is written down: once an hour for a key and an
    object in an API process, beside the requests and best effort. Reading waits for no writer, and
    goes on when the disk is full.
    """

    def __init__(self, store: Store) -> None:
        super().__init__("reads", EVERY)
        self._store = store
        self._lock = threading.Lock()
        self._known: OrderedDict[tuple[str, ...], float] = OrderedDict()
        self._waiting: list[dict[str, object]] = []
        self._left_out = 0

    def note(self, who: Principal, action: str, object_id: str) -> None:
        """Note that ``who`` read something, if that has not been noted within the hour."""
        read = (who.tenant_id, who.key_id, action, object_id)
        moment = time.monotonic()
        with self._lock:
            if moment - self._known.get(read, -ONCE_IN) < ONCE_IN:
                return
            if len(self._waiting) >= MOST_WAITING:
                self._left_out += 1
                return
            self._known[read] = moment
            self._known.move_to_end(read)
            while len(self._known) > MOST_KNOWN:
                self._known.popitem(last=False)
            self._waiting.append(_entry(who, action, object_id, now()))

    def stop(self) -> None:
        """Stop; what was noted last is written as well."""
        super().stop()
        with suppress(SQLAlchemyError):
            self._round()

    def _round(self) -> None:
        with self._lock:
            noted = list(self._waiting)
            left_out = self._left_out
        if noted:
            with self._store.write() as session:
                session.add_all(AuditEntry(**each) for each in noted)
        with self._lock:
            del self._waiting[: len(noted)]
            self._left_out -= left_out
        if left_out:
            log.error("reads.not_in_audit", count=left_out)
