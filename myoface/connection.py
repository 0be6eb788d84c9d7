"""Requests over a line that may break."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx

from myoface.errors import UNREACHABLE, ApiError

ATTEMPTS = 8
FIRST_PAUSE_S = 0.1
LONGEST_PAUSE_S = 8.0


class Patience:
    """Waits longer after each failure in a row and gives up after ``ATTEMPTS``."""

    def __init__(self) -> None:
        self.failures = 0

    def reset(self) -> None:
        """Forget the failures: something went through."""
        self.failures = 0

    def failed(self, error: ApiError) -> None:
        """Pause after a failure, or raise ``error`` if there were too many."""
        self.failures += 1
        if self.failures >= ATTEMPTS:
            raise error
        time.sleep(min(FIRST_PAUSE_S * 2**self.failures, LONGEST_PAUSE_S))

    @contextmanager
    def retrying(self) -> Iterator[None]:
        """Turn a transport failure, or a service that is not ready (503), into a pause.

        The last one becomes an :class:`ApiError`.
        """
        try:
            yield
        except httpx.TransportError as error:
            self.failed(unreachable(error))
        except ApiError as error:
            if error.status != httpx.codes.SERVICE_UNAVAILABLE:
                raise
            self.failed(error)


def once(http: httpx.Client, method: str, url: str, **request: Any) -> httpx.Response:
    """Send a request; whatever goes wrong is an :class:`ApiError`."""
    try:
        return checked(http.request(method, url, **request))
    except httpx.TransportError as error:
        raise unreachable(error) from error


def patiently(http: httpx.Client, method: str, url: str, **request: Any) -> httpx.Response:
    """Send a request that may be repeated without harm, as often as the line breaks."""
    patience = Patience()
    while True:
        with patience.retrying():
            return checked(http.request(method, url, **request))


def checked(response: httpx.Response) -> httpx.Response:
    """Return ``response``, or raise its problem as :class:`ApiError`."""
    if response.is_error:
        response.read()
        raise ApiError.from_response(response)
    return response


def unreachable(error: httpx.TransportError) -> ApiError:
    """Return the error of a service that does not answer."""
    detail = f"no answer from {error.request.url}: {str(error) or type(error).__name__}"
    return ApiError({"code": UNREACHABLE, "detail": detail})
