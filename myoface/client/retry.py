"""Decide which failed requests are repeated, and after how long a pause."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import httpx

from myoface.client.proxies import BAD_PROXY, told
from myoface.errors import UNREACHABLE, ApiError

# Another request under the same Idempotency-Key has not been answered yet.
IN_FLIGHT = "idempotency.in_flight"


@dataclass(frozen=True)
class ClientOptions:
    """Patience of a client, and the portions it asks for."""

    timeout_s: float = 30.0  # for an answer
    connect_s: float = 10.0  # for somebody at the address
    # The service sends a comment line at least this often while a job has no news.
    events_timeout_s: float = 60.0
    attempts: int = 8  # failures in a row after which a request is given up
    first_pause_s: float = 0.1  # doubled at each failure
    longest_pause_s: float = 8.0
    longest_wish_s: float = 120.0  # a Retry-After beyond this is a refusal
    page_items: int = 1000  # the service lists at most so many at a time
    frame_page_items: int = 100
    frame_pause_s: float = 0.5  # between looks for frames that are not ready
    batch_pause_s: float = 1.0  # between looks at a running batch
    stream_pause_s: float = 2.0  # where the service has no event stream to spare
    live_ready_s: float = 900.0  # until a live session is ready: its rig's skin may be made first
    wait_s: float = 600.0  # that the service may be away while something is waited for
    live_frame_s: float = 1.0  # for the answer to a frame, which may have been dropped
    chunk_bytes: int = 4 * 1024 * 1024  # of an upload, in one request


DEFAULT_OPTIONS = ClientOptions()


BUSY = "database.busy"
# of a service, or of the proxy in front of one that is being restarted
AWAY = (httpx.codes.BAD_GATEWAY, httpx.codes.SERVICE_UNAVAILABLE, httpx.codes.GATEWAY_TIMEOUT)


class Backoff:
    """Pauses that double at each failure in a row, up to a number of attempts.

    Before ``patience_s`` since the first of them no number of failures is too many.
    """

    def __init__(self, options: ClientOptions = DEFAULT_OPTIONS, patience_s: float = 0.0) -> None:
        self.failures = 0
        self._options = options
        self._patience = patience_s
        self._until = 0.0

    def reset(self) -> None:
        """Forget the failures: something went through."""
        self.failures = 0

    def pause_after(self, error: ApiError) -> float:
        """Return the seconds to wait after a failure, or raise ``error`` if it is one too many."""
        options = self._options
        wish = requested_pause(error)
        if self.failures == 0:
            self._until = time.monotonic() + self._patience
        self.failures += 1
        is_enough = self.failures >= options.attempts and time.monotonic() > self._until
        if is_enough or (wish or 0) > options.longest_wish_s:
            raise error
        doubled = options.first_pause_s * 2 ** min(self.failures, 20)
        return wish or min(doubled, options.longest_pause_s)

    def pause_if_transient(self, error: ApiError) -> float:
        """Return the seconds to wait after a failure that may pass; raise one that will not."""
        if not _is_transient(error):
            raise error
        return self.pause_after(error)


@contextmanager
def transport_errors(proxy: httpx.Proxy | None = None) -> Iterator[None]:
    """Turn a broken connection inside the block into an :class:`ApiError`.

    A proxy that refuses is one that lasts, with ``client.proxy``; one that cannot be reached is
    named.
    """
    try:
        yield
    except httpx.TransportError as error:
        by = f" by the proxy {told(proxy)}" if proxy else ""
        detail = f"no answer from {error.request.url}{by}: {str(error) or type(error).__name__}"
        code = BAD_PROXY if isinstance(error, httpx.ProxyError) else UNREACHABLE
        raise ApiError({"code": code, "detail": detail}) from error


def requested_pause(error: ApiError) -> float | None:
    """Return the seconds after which the service wants to be asked again, if it says so."""
    text = str(error.problem.get("retry_after", ""))
    return float(text) if text.isdigit() else None


def is_too_fast(error: ApiError) -> bool:
    """Return True if the service asks to slow down; a quota is no matter of seconds."""
    is_quota = error.code.startswith("quota.")
    return error.status == httpx.codes.TOO_MANY_REQUESTS and not is_quota


def is_never_reached(error: ApiError) -> bool:
    """Return True if there was nobody to connect to."""
    return isinstance(error.__cause__, (httpx.ConnectError, httpx.ConnectTimeout))


def came_to_nothing(error: ApiError) -> bool:
    """Return True if the service says that it has done nothing of what was asked."""
    return is_too_fast(error) or error.code == BUSY


def _is_transient(error: ApiError) -> bool:
    return error.code in (UNREACHABLE, IN_FLIGHT) or error.status in AWAY or came_to_nothing(error)
