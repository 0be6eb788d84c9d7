"""``python -m worker ingest|short|long|webhooks``: a worker for one queue."""

from __future__ import annotations

import argparse
import signal

from service import logs
from service.parent import die_with_parent
from service.store.queue import QUEUES, WEBHOOKS
from worker import deliver
from worker.app import NAME, app, settings, store


def main() -> None:
    """Work until told to stop."""
    parser = argparse.ArgumentParser(prog="python -m worker", description=__doc__)
    parser.add_argument("queue", choices=(*QUEUES, WEBHOOKS))
    queue = parser.parse_args().queue
    logs.configure(settings.log_json)
    if settings.stack_pid:
        die_with_parent(settings.stack_pid, signal.SIGTERM)
    if queue == WEBHOOKS:
        deliver.main(store, settings, NAME)
        return
    concurrency = getattr(settings, f"{queue}_workers")
    # Threads: each only watches a solver process, and all end with this process.
    app.worker_main(
        [
            "--quiet",
            "worker",
            "--pool=threads",
            f"--concurrency={concurrency}",
            f"--queues={queue}",
            f"--hostname={queue}@%h",
            "--without-gossip",
            "--without-mingle",
        ]
    )


if __name__ == "__main__":
    main()
