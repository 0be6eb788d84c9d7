"""The Celery application: one task, and the sweeper beside it."""

from __future__ import annotations

import os
import socket
import threading
from typing import Any

from celery import signals

from service.settings import Settings
from service.store.queue import RUN_JOB, celery_app
from service.store.store import Store
from worker.supervise import Supervisor
from worker.sweeper import Sweeper

NAME = f"{socket.gethostname()}:{os.getpid()}"

settings = Settings()
app = celery_app(settings.broker)
store = Store(settings.database, settings.files, settings.broker)
stopping = threading.Event()


def run_job(job_id: str) -> None:
    """Do a job, if it is still to be had."""
    Supervisor(store, settings, NAME, stopping).run(job_id)


def _migrate(**_: Any) -> None:
    store.database.migrate()


def _sweep(sender: Any, **_: Any) -> None:
    queue = ",".join(sender.app.amqp.queues.consume_from)
    Sweeper(store, settings, NAME, queue, stopping).start()


def _stop(**_: Any) -> None:
    stopping.set()


def _leave_logging_alone(**_: Any) -> None:
    """Celery sets up logging unless somebody listens here; `service.logs` has done it."""


app.task(name=RUN_JOB)(run_job)
signals.worker_init.connect(_migrate)
signals.worker_ready.connect(_sweep)
signals.worker_shutting_down.connect(_stop)
signals.setup_logging.connect(_leave_logging_alone)
