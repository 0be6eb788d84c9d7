"""Batches go on: one API process of all looks after them, since only the API resolves inputs."""

from __future__ import annotations

import os
import socket

import structlog

from service.background import Background
from service.batches import repository, service
from service.errors import Problem
from service.settings import Settings
from service.store.store import Store
from service.store.sweep import hold_office

OFFICE = "batches"

log = structlog.get_logger()


class Advancer(Background):
    """A thread that queues what running batches need next, every ``settings.beat`` s."""

    def __init__(self, store: Store, settings: Settings) -> None:
        super().__init__("batches", settings.beat)
        self._store = store
        self._settings = settings
        self._holder = f"{socket.gethostname()}:{os.getpid()}"

    def _round(self) -> None:
        with self._store.read() as session:
            running = repository.running(session)
        if not running:
            return
        with self._store.write() as session:
            if not hold_office(session, OFFICE, self._holder, 10 * self._settings.beat):
                return
        for tenant_id, batch_id in running:
            try:
                with self._store.of(tenant_id).write() as session:
                    service.advance(session, batch_id, self._settings.max_attempts)
            except Problem:
                log.info("batch.gone", batch_id=batch_id)  # deleted with its subject
            except Exception:  # one that can not go on keeps no other from it
                log.exception("batch.stuck", batch_id=batch_id)
