"""How long clients wait for an answer, by route."""

from __future__ import annotations

import time

from prometheus_client import CollectorRegistry, Histogram
from starlette.types import ASGIApp, Message, Receive, Scope, Send

BUCKETS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.15, 0.25, 0.5, 1, 2.5, 5, 10, 30)
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
OTHER = "other"


class Latency:
    """Measures the time until an answer begins: events and downloads last as long as they last."""

    def __init__(self, app: ASGIApp, registry: CollectorRegistry) -> None:
        self._app = app
        self._seconds = Histogram(
            "http_request_seconds",
            "Time until the answer began",
            ["route", "method", "status"],
            buckets=BUCKETS,
            registry=registry,
        )

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        started = time.perf_counter()

        async def send_and_measure(message: Message) -> None:
            if message["type"] == "http.response.start":
                self._seconds.labels(route_of(scope), method_of(scope), message["status"]).observe(
                    time.perf_counter() - started
                )
            await send(message)

        await self._app(scope, receive, send_and_measure)


def route_of(scope: Scope) -> str:
    """Return the route's template, never the address: that may name what nobody should count."""
    return getattr(scope.get("route"), "path", OTHER)


def method_of(scope: Scope) -> str:
    """Return the method if it is one of HTTP's own: any word may come."""
    method: str = scope["method"]
    return method if method in METHODS else OTHER
