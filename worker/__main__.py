"""``python -m worker ingest|short|long|live|webhooks``: a worker for one queue."""

from __future__ import annotations

import argparse
import signal
import sys
import threading

from service import tracing
from service.process import configure_logs, die_with_parent, forbid_dumps, keep_private
from service.queue.wakeups import LIVE, QUEUES, WEBHOOKS
from service.settings import Settings
from service.store.database import Store
from worker import deliver, kernels
from worker.abilities import abilities
from worker.app import work


def main() -> None:
    """Work until told to stop."""
    keep_private()
    parser = argparse.ArgumentParser(prog="python -m worker", description=__doc__)
    parser.add_argument("queue", choices=(*QUEUES, WEBHOOKS))
    parser.add_argument(
        "--kinds", default="", help="the only kinds of job to do, with commas; default: all"
    )
    parser.add_argument(
        "--compile", action="store_true", help="compile the solver's kernels, beside the work"
    )
    given = parser.parse_args()
    settings = Settings()
    try:
        can = abilities(settings, filter(None, given.kinds.split(",")))
    except ValueError as error:
        parser.error(str(error))
    forbid_dumps()
    configure_logs(settings.log_json)
    tracing.start(f"myoface-{given.queue}")
    if settings.stack_pid:
        die_with_parent(settings.stack_pid, signal.SIGTERM)
    if given.compile:
        threading.Thread(target=kernels.compile_all, daemon=True).start()
    store = Store(settings.database, settings.files, settings.broker)
    if given.queue == LIVE and not settings.live_workers:
        sys.exit("MYOFACE_LIVE_WORKERS is 0: nobody would hold a session")
    if given.queue == WEBHOOKS:
        deliver.main(store, settings, can)
        return
    work(store, settings, given.queue, can)


if __name__ == "__main__":
    main()
