"""A customer who works while others misbehave, and an API in a process of its own to serve both."""

from __future__ import annotations

import itertools
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx

ASK_EVERY = 0.05
START_S = 60.0
WHO_AM_I: tuple[str, str, Any] = ("GET", "/v1/me", None)


class Customer(threading.Thread):
    """Asks until ``stop`` is set: ``asks`` in turn, each a method, a path and a body for JSON.

    ``fresh`` means by a new connection each time.
    """

    def __init__(
        self,
        name: str,
        url: str,
        key: str,
        stop: threading.Event,
        asks: Sequence[tuple[str, str, Any]] = (WHO_AM_I,),
        *,
        fresh: bool = False,
    ) -> None:
        super().__init__(name=name, daemon=True)
        self.waits: list[float] = []
        self.refused: list[str] = []
        self._url = url
        self._headers = {"Authorization": f"Bearer {key}"}
        self._stop_asked = stop
        self._asks = asks
        self._fresh = fresh

    @property
    def p95(self) -> float:
        """The wait in seconds that 95 of 100 requests did not exceed."""
        return sorted(self.waits)[int(0.95 * len(self.waits))]

    def run(self) -> None:
        """Ask, again and again."""
        http = self._client()
        for method, path, body in itertools.cycle(self._asks):
            if self._stop_asked.wait(ASK_EVERY):
                break
            if self._fresh:
                http.close()
                http = self._client()
            begun = time.monotonic()
            try:
                http.request(method, path, json=body).raise_for_status()
            except httpx.HTTPError as error:
                self.refused.append(repr(error))
            self.waits.append(time.monotonic() - begun)
        http.close()

    def tell(self) -> list[str]:
        """Return lines that say what the customer met with."""
        head = (
            f"{len(self.waits):8} requests of a customer, {self.name}: "
            f"{len(self.refused)} refused, p95 {1000 * self.p95:.0f} ms, "
            f"worst {1000 * max(self.waits):.0f} ms"
        )
        return [head, *(f"         {problem}" for problem in self.refused[:3])]

    def _client(self) -> httpx.Client:
        return httpx.Client(base_url=self._url, headers=self._headers, timeout=30, trust_env=False)


@contextmanager
def own_api(folder: Path) -> Iterator[tuple[int, str]]:
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
