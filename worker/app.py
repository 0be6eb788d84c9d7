"""The Celery application: one task, and the sweeper beside it."""

from __future__ import annotations

import threading
from typing import Any

from celery import signals

from service.queue.claims import Abilities
from service.queue.wakeups import INGEST, LIVE, RUN_JOB, celery_app
from service.settings import Settings
from service.store.database import Store
from worker.lookout import Lookout, Presence
from worker.process import Standby
from worker.supervise import Supervisor
from worker.sweeper import Sweeper


def work(store: Store, settings: Settings, queue: str, can: Abilities) -> None:
    """Do the jobs of ``queue`` that this worker can do, until told to stop."""
    app = celery_app(settings.broker)
    stopping = threading.Event()
    slots = getattr(settings, f"{queue}_workers")

    # checks and sessions are waited for: what their processes load counts
    ready = {INGEST: slots * settings.ingest_standby, LIVE: settings.live_standby}
    standby = Standby(settings, ready.get(queue, 0), live=queue == LIVE)
    free = threading.Semaphore(slots)

    def run_jobs(_job_id: str) -> None:
        """Do the queue's jobs, the best first, until there is none to be had."""
        supervisor = Supervisor(store, settings, can, stopping, standby)
        with free:
            while not stopping.is_set() and supervisor.run_next(queue):
                pass

    def is_free() -> bool:
        if free.acquire(blocking=False):
            free.release()
            return True
        return False

    def migrate(**_: Any) -> None:
        store.database.migrate()

    def sweep(**_: Any) -> None:
        Sweeper(store, settings, queue, can, slots, stopping).start()
        if queue == LIVE:
            presence = Presence(settings.work, can.worker)
            Lookout(store, presence, settings.live_silence, is_free, stopping).start()

    def stop(**_: Any) -> None:
        stopping.set()

    def leave_logging_alone(**_: Any) -> None:
        """Celery sets up logging unless somebody listens here; `service.process` has done it."""

    app.task(name=RUN_JOB)(run_jobs)
    for signal, listener in (
        (signals.worker_init, migrate),
        (signals.worker_ready, sweep),
        (signals.worker_shutting_down, stop),
        (signals.setup_logging, leave_logging_alone),
    ):
        signal.connect(listener, weak=False)
    standby.fill()
    words = [
        "--quiet",
        "worker",
        "--pool=threads",  # each only watches a solver process, and all end with this process
        f"--concurrency={slots}",
        f"--queues={queue}",
        f"--hostname={queue}@%h",
        "--without-gossip",
        "--without-mingle",
    ]
    try:
        app.worker_main(words)
    finally:
        standby.stop()
