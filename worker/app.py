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


@app.task(name=RUN_JOB)
def run_job(job_id: str) -> None:
    """Do a job, if it is still to be had."""
    Supervisor(store, settings, NAME, stopping).run(job_id)


@signals.worker_init.connect
def _migrate(**_: Any) -> None:
    store.database.migrate()


@signals.worker_ready.connect
def _sweep(sender: Any, **_: Any) -> None:
    queue = ",".join(sender.app.amqp.queues.consume_from)
    Sweeper(store, settings, NAME, queue, stopping).start()


@signals.worker_shutting_down.connect
def _stop(**_: Any) -> None:
    stopping.set()


@signals.setup_logging.connect
def _leave_logging_alone(**_: Any) -> None:
    """Celery sets up logging unless somebody listens here; `service.logs` has done it."""
