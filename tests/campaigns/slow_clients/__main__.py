"""``python -m tests.campaigns.slow_clients``: 2,000 without a key, and a customer who notices none.

Starts an API of its own on this machine and besieges it from loopback, with silence, slow headers,
slow bodies, and slow bodies behind a forged key. A customer asks all the while, by a connection
that stays and by a new one each time. Prints what each met with; exits with 1 if the customer was
ever refused or waited longer than half a second (p95).
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import threading
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from typer import echo as say

from tests.campaigns.customer import Customer, own_api
from tests.campaigns.slow_clients.crowd import besiege

MOST_S = 0.5


def main() -> int:
    """Besiege a service; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.campaigns.slow_clients", description=__doc__
    )
    parser.add_argument("--clients", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=60)
    given = parser.parse_args()
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    with (
        tempfile.TemporaryDirectory(prefix="myoface-slow-clients-") as folder,
        own_api(Path(folder)) as (port, key),
    ):
        return _run(port, key, given.clients, given.seconds)


def _run(port: int, key: str, clients: int, seconds: float) -> int:
    stop = threading.Event()
    url = f"http://127.0.0.1:{port}"
    customers = [
        Customer("one connection", url, key, stop),
        Customer("new connections", url, key, stop, fresh=True),
    ]
    for customer in customers:
        customer.start()
    with ProcessPoolExecutor(1, get_context("spawn")) as apart:  # the customer has a process alone
        ends = apart.submit(besiege, port, clients, seconds).result()
    stop.set()
    for end, count in sorted(ends.items()):
        say(f"{count:8} slow clients' connections: {end}")
    for customer in customers:
        customer.join()
        say("\n".join(customer.tell()))
    return int(any(customer.refused or customer.p95 > MOST_S for customer in customers))


if __name__ == "__main__":
    sys.exit(main())
