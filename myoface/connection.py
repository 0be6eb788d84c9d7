"""Requests over a line that may break, for clients that block and for those that do not.

What a client does is written once, as a *flow*: a generator that yields the steps it wants taken
and is sent their answers. `myoface.client` has a driver that blocks and one that awaits. A broken
line is thrown into the flow as an :class:`ApiError`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

import httpx

from myoface.errors import UNREACHABLE, ApiError

ATTEMPTS = 8
FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 8.0
LONGEST_WISH_S = 120.0
"""A ``Retry-After`` beyond this is a refusal."""

IN_FLIGHT = "idempotency.in_flight"

R = TypeVar("R")


@dataclass(frozen=True)
class Send:
    """A request; answered with the whole :class:`httpx.Response`."""

    method: str
    url: str
    options: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Open(Send):
    """A request whose answer is read by :class:`Read`; an error's is there as a whole."""


@dataclass(frozen=True)
class Read:
    """The next bytes of what was opened last; answered with None at the end."""


@dataclass(frozen=True)
class Pause:
    """Seconds to wait."""

    seconds: float


@dataclass(frozen=True)
class Work:
    """Something that takes a while without the service, such as reading a whole file."""

    function: Callable[[], Any]


Step = Send | Read | Pause | Work
Flow = Generator[Step, Any, R]


class Patience:
    """Waits longer after each failure in a row and gives up after ``ATTEMPTS``."""

    def __init__(self) -> None:
        self.failures = 0

    def reset(self) -> None:
        """Forget the failures: something went through."""
        self.failures = 0

    def pause(self, error: ApiError) -> float:
        """Return how long to wait after a failure, or raise ``error`` if there were too many."""
        self.failures += 1
        wish = wished(error)
        if self.failures >= ATTEMPTS or (wish or 0) > LONGEST_WISH_S:
            raise error
        return wish or min(FIRST_PAUSE_S * 2**self.failures, LONGEST_PAUSE_S)

    def bear(self, error: ApiError) -> Flow[None]:
        """Wait after a failure that may pass; raise one that will not, or the last."""
        if not _may_pass(error):
            raise error
        yield from self.wait(error)

    def wait(self, error: ApiError) -> Flow[None]:
        """Wait after a failure, or raise ``error`` if there were too many."""
        yield Pause(self.pause(error))

    def failed(self, error: ApiError) -> None:
        """Wait here after a failure, or raise ``error`` if there were too many."""
        time.sleep(self.pause(error))

    @contextmanager
    def retrying(self) -> Iterator[None]:
        """Turn a failure that may pass into a wait here."""
        try:
            yield
        except httpx.TransportError as error:
            self.failed(unreachable(error))
        except ApiError as error:
            if not _may_pass(error):
                raise
            self.failed(error)


def once(method: str, url: str, **options: Any) -> Flow[httpx.Response]:
    """Send a request that must not reach the service twice; too fast a one did not reach it."""
    patience = Patience()
    while True:
        try:
            return checked((yield Send(method, url, options)))
        except ApiError as error:
            if not _is_too_fast(error):
                raise
            yield from patience.wait(error)


def patiently(
    method: str, url: str, *, through: bool = False, **options: Any
) -> Flow[httpx.Response]:
    """Send a request that may be repeated without harm, as often as the line breaks.

    A service that is not there at the first try is an error at once, unless ``through``: it was
    there just now.
    """
    patience = Patience()
    while True:
        try:
            return checked((yield Send(method, url, options)))
        except ApiError as error:
            is_first = patience.failures == 0 and not through
            if is_first and isinstance(error.__cause__, httpx.ConnectError):
                raise
            yield from patience.bear(error)


def checked(response: httpx.Response) -> httpx.Response:
    """Return ``response``, or raise its problem as :class:`ApiError`."""
    if not response.is_error:
        return response
    response.read()
    error = ApiError.from_response(response)
    if "Retry-After" in response.headers:
        error.problem.setdefault("retry_after", response.headers["Retry-After"])
    raise error


def unreachable(error: httpx.TransportError) -> ApiError:
    """Return the error of a service that does not answer."""
    detail = f"no answer from {error.request.url}: {str(error) or type(error).__name__}"
    fault = ApiError({"code": UNREACHABLE, "detail": detail})
    fault.__cause__ = error
    return fault


def wished(error: ApiError) -> float | None:
    """Return the seconds after which the service wants to be asked again, if it says so."""
    text = str(error.problem.get("retry_after", ""))
    return float(text) if text.isdigit() else None


def _may_pass(error: ApiError) -> bool:
    return (
        error.code in (UNREACHABLE, IN_FLIGHT)
        or error.status == httpx.codes.SERVICE_UNAVAILABLE
        or _is_too_fast(error)
    )


def _is_too_fast(error: ApiError) -> bool:
    """Whether the service asks to slow down; a quota is no matter of seconds."""
    is_quota = error.code.startswith("quota.")
    return error.status == httpx.codes.TOO_MANY_REQUESTS and not is_quota
