"""``python -m tests.campaigns.slow_clients``: 2,000 without a key, and a customer who notices none.

Starts an API of its own on this machine and besieges it from loopback, with silence, slow headers,
slow bodies, and slow bodies behind a forged key. A customer asks all the while, by a connection
that stays and by a new one each time. Prints what each met with; exits with 1 if the customer was
ever refused or waited longer than half a second (p95).
"""

from __future__ import annotations

import argparse
import os
import resource
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path

import httpx
from typer import echo as say

from tests.campaigns.slow_clients.crowd import besiege

MOST_S = 0.5
ASK_EVERY = 0.05
START_S = 60.0


class Customer(threading.Thread):
    """Asks until ``stop`` is set; ``fresh`` means by a new connection each time."""

    def __init__(self, url: str, key: str, stop: threading.Event, fresh: bool) -> None:
        super().__init__(name="new connections" if fresh else "one connection", daemon=True)
        self.waits: list[float] = []
        self.refused: list[str] = []
        self._url = url
        self._headers = {"Authorization": f"Bearer {key}"}
        self._stop_asked = stop
        self._fresh = fresh

    def run(self) -> None:
        """Ask whose key it is, again and again."""
        http = self._client()
        while not self._stop_asked.wait(ASK_EVERY):
            if self._fresh:
                http.close()
                http = self._client()
            begun = time.monotonic()
            try:
                http.get("/v1/me").raise_for_status()
            except httpx.HTTPError as error:
                self.refused.append(repr(error))
            self.waits.append(time.monotonic() - begun)
        http.close()

    def _client(self) -> httpx.Client:
        return httpx.Client(base_url=self._url, headers=self._headers, timeout=30, trust_env=False)


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
        _served(Path(folder)) as (port, key),
    ):
        return _run(port, key, given.clients, given.seconds)


def _run(port: int, key: str, clients: int, seconds: float) -> int:
    stop = threading.Event()
    customers = [Customer(f"http://127.0.0.1:{port}", key, stop, fresh) for fresh in (False, True)]
    for customer in customers:
        customer.start()
    with ProcessPoolExecutor(1, get_context("spawn")) as apart:  # the customer has a process alone
        ends = apart.submit(besiege, port, clients, seconds).result()
    stop.set()
    for end, count in sorted(ends.items()):
        say(f"{count:8} slow clients' connections: {end}")
    well = True
    for customer in customers:
        customer.join()
        p95 = sorted(customer.waits)[int(0.95 * len(customer.waits))]
        say(
            f"{len(customer.waits):8} requests of a customer, {customer.name}: "
            f"{len(customer.refused)} refused, p95 {1000 * p95:.0f} ms, "
            f"worst {1000 * max(customer.waits):.0f} ms"
        )
        for problem in customer.refused[:3]:
            say(f"         {problem}")
        well = well and not customer.refused and p95 <= MOST_S
    return int(not well)


@contextmanager
def _served(folder: Path) -> Iterator[tuple[int, str]]:
    """Serve the API from a process of its own, without broker and workers; gives port and key."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    own = {"MYOFACE_DATA_DIR": str(folder), "MYOFACE_PORT": str(port)}
    with (folder / "log").open("wb") as log:
        api = subprocess.Popen(
            [sys.executable, "-m", "service"], env=os.environ | own, stdout=log, stderr=log
        )
    try:
        until = time.monotonic() + START_S
        while True:
            try:
                httpx.get(f"http://127.0.0.1:{port}/healthz", trust_env=False)
                break
            except httpx.TransportError:
                if time.monotonic() > until or api.poll() is not None:
                    raise
                time.sleep(0.2)
        yield port, (folder / "admin.key").read_text()
    finally:
        api.terminate()
        api.wait(10)


if __name__ == "__main__":
    sys.exit(main())
