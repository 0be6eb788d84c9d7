"""``python -m tests.campaigns.costs``: what the worst requests cost, and who waits for them.

Sends the worst megabyte of each kind's options and of each route to a service in this process, and
prints the dearest of each: processor time, memory and answer. Then eight callers send the dearest
of all again and again to an API of its own, while another tenant reads and writes. At last somebody
holds SQLite's right to write, 45 callers wait for it, and a customer reads. Exits with 1 if
refusing costs more than half a second, 50 MB or an answer of 64 KB, if the other tenant was ever
refused or waited longer than 300 ms (p95), or if a writer was not told within 6 s to come back.
"""

from __future__ import annotations

import argparse
import itertools
import logging
import sqlite3
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import closing
from multiprocessing import get_context
from operator import attrgetter
from pathlib import Path

import httpx
import structlog
from rich.console import Console
from rich.table import Table
from typer import echo as say

from service.access.bootstrap import add_tenant
from service.access.keys import Keyring
from service.secret import secret
from service.settings import Settings
from service.store.database import Store
from solver.kinds import KINDS
from tests.campaigns.costs.callers import CALLERS, call
from tests.campaigns.costs.worst import Cost, Order, measure, orders_of, orders_of_routes, places_of
from tests.campaigns.customer import WHO_AM_I, Customer, own_api
from tests.service_client import served

MOST_WAIT_S = 0.3
# Callers that wait for the right to write, and the seconds after which they must have been told
WRITERS = 45
MOST_PATIENCE_S = 6.0
DEAREST = 8
READS = (WHO_AM_I, ("GET", "/v1/jobs?limit=50", None), ("GET", "/v1/subjects", None))
WRITES = (("POST", "/v1/subjects", {"name": "Alex"}),)


def main() -> int:
    """Measure; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tests.campaigns.costs", description=__doc__)
    parser.add_argument("--seconds", type=float, default=30, help="with callers, of each kind")
    given = parser.parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    with tempfile.TemporaryDirectory(prefix="myoface-costs-") as folder:
        costs = list(_costs(Path(folder)))
    _show(costs)
    dear = [cost for cost in costs if not cost.is_small]
    for cost in dear:
        say(f"too dear: {cost}")
    jobs = [cost for cost in costs if cost.order.path == "/v1/jobs"]
    dearest = sorted(jobs, key=attrgetter("seconds"), reverse=True)[:DEAREST]
    with tempfile.TemporaryDirectory(prefix="myoface-costs-") as folder:
        well = _stand_beside([cost.order for cost in dearest], Path(folder), given.seconds)
    with tempfile.TemporaryDirectory(prefix="myoface-costs-") as folder:
        well &= _stand_behind_a_lock(Path(folder), given.seconds)
    return int(bool(dear) or not well)


def _costs(folder: Path) -> Iterator[Cost]:
    """Give the cost of every order."""
    with served(Settings(data_dir=folder, rate_per_minute=10**9)) as studio:
        subject = studio.post("/v1/subjects", name="Alex")["id"]
        orders = (orders_of(kind, place, subject) for kind in KINDS for place in places_of(kind))
        routes = orders_of_routes(studio.get("/openapi.json"))
        for order in itertools.chain(*orders, routes):
            yield measure(order, studio.http)


def _show(costs: Sequence[Cost]) -> None:
    """Print the worst of each kind and of each route."""
    table = Table("kind, route", "n", "s", "by", "MB", "by", "answer, bytes", "by")
    for about, found in itertools.groupby(costs, lambda cost: cost.order.about):
        of_it = list(found)
        slow, large, long = (
            max(of_it, key=attrgetter(name)) for name in ("seconds", "megabytes", "answer")
        )
        table.add_row(
            about,
            str(len(of_it)),
            *(f"{slow.seconds:.3f}", slow.order.how),
            *(f"{large.megabytes:.1f}", large.order.how),
            *(str(long.answer), long.order.how),
        )
    Console(width=160).print(table)


def _stand_beside(orders: Sequence[Order], folder: Path, seconds: float) -> bool:
    """Let callers send ``orders`` to an API beside another tenant; returns if it stood that."""
    with own_api(folder) as (port, key):
        url = f"http://127.0.0.1:{port}"
        stop = threading.Event()
        other = _another_tenant(Settings(data_dir=folder))
        customers = [
            Customer("another tenant, reading", url, other, stop, READS),
            Customer("another tenant, writing", url, other, stop, WRITES),
        ]
        for customer in customers:
            customer.start()
        with ProcessPoolExecutor(1, get_context("spawn")) as apart:
            answers = apart.submit(call, url, key, orders, seconds).result()
        stop.set()
        for customer in customers:
            customer.join()
    say(f"{CALLERS} callers for {seconds:.0f} s: answers {dict(sorted(answers.items()))}")
    for customer in customers:
        say("\n".join(customer.tell()))
    return not any(each.refused or each.p95 > MOST_WAIT_S for each in customers)


def _stand_behind_a_lock(folder: Path, seconds: float) -> bool:
    """Hold the right to write before callers who want it; returns if readers stood that."""
    callers = ThreadPoolExecutor(WRITERS)
    other = sqlite3.connect(folder / "myoface.db", isolation_level=None, check_same_thread=False)
    with own_api(folder) as (port, key), callers, closing(other), _many(port, key) as http:
        url = f"http://127.0.0.1:{port}"
        stop = threading.Event()
        customer = Customer("reading behind a lock", url, key, stop, READS)

        def write(until: float) -> list[tuple[int, float]]:
            answers: list[tuple[int, float]] = []
            while not answers or time.monotonic() < until:
                begun = time.monotonic()
                status = http.post("/v1/subjects", json={"name": "Alex"}).status_code
                answers.append((status, time.monotonic() - begun))
            return answers

        other.execute("BEGIN IMMEDIATE")
        customer.start()
        locked = callers.map(write, [time.monotonic() + seconds] * WRITERS)
        told = list(itertools.chain(*locked))
        stop.set()
        customer.join()
        other.execute("ROLLBACK")
        after = Counter(status for (status, _), *_ in callers.map(write, [0.0] * WRITERS))
    statuses = Counter(status for status, _ in told)
    longest = max(took for _, took in told)
    say(f"{WRITERS} writers behind a lock: answers {dict(statuses)}, within {longest:.1f} s")
    say("\n".join([*customer.tell(), f"after it: answers {dict(after)}"]))
    were_told = set(statuses) == {503} and longest <= MOST_PATIENCE_S
    reads = not customer.refused and customer.p95 <= MOST_WAIT_S
    return were_told and reads and after == {201: WRITERS}


def _many(port: int, key: str) -> httpx.Client:
    """Return a client for all writers at once."""
    return httpx.Client(
        base_url=f"http://127.0.0.1:{port}",
        headers={"Authorization": f"Bearer {key}"},
        timeout=60,
        limits=httpx.Limits(max_connections=WRITERS),
        trust_env=False,
    )


def _another_tenant(settings: Settings) -> str:
    """Return a key of a new tenant."""
    path = settings.data_dir / "other.key"
    store = Store(settings.database, settings.files, settings.broker)
    add_tenant(store, Keyring(store, secret(settings)), "other", path)
    store.close()
    return path.read_text()


if __name__ == "__main__":
    sys.exit(main())
