"""WebSockets of the client, by the library ``websockets``: awaited, and blocking."""

from __future__ import annotations

import json
import ssl
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from types import ModuleType
from typing import Any

import anyio
import httpx

from myoface.errors import UNREACHABLE, ApiError

MISSING = "client.live"
CLOSED = "client.closed"
OPENS_WITHIN = 10.0  # s


def address_of(base: str, url: str) -> str:
    """Return the address of a WebSocket that a service named by a ``url`` relative to its own."""
    return str(httpx.URL(base.rstrip("/") + url)).replace("http", "ws", 1)


def describe_proxy(proxy: httpx.Proxy | None) -> str | None:
    """Return a proxy's address with its password."""
    if proxy is None:
        return None
    user, password = proxy.auth or (None, None)
    return str(proxy.url.copy_with(username=user, password=password) if user else proxy.url)


class AsyncSocket:
    """A connection whose calls are awaited; each raises :class:`ApiError` when it is closed.

    That has the code ``client.closed``, and in ``close`` the connection's own.
    """

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    @classmethod
    async def open(
        cls, url: str, authority: ssl.SSLContext | bool, proxy: str | None
    ) -> AsyncSocket:
        """Connect; raises the service's problem where it refuses."""
        library = _library("asyncio")
        with _errors():
            how = _settings(url, authority, proxy)
            return cls(await library.connect(url, **how))

    async def send(self, message: bytes | str) -> None:
        """Send a message."""
        with _errors():
            await self._connection.send(message)

    async def receive(self, timeout: float | None) -> bytes | str | None:
        """Return the next message; None: there is none within ``timeout`` seconds."""
        with _errors():
            with anyio.move_on_after(timeout):
                message: bytes | str = await self._connection.recv()
                return message
        return None

    async def close(self) -> None:
        """Close the connection."""
        await self._connection.close()


class Socket:
    """A connection whose calls block; see :class:`AsyncSocket`."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    @classmethod
    def open(cls, url: str, authority: ssl.SSLContext | bool, proxy: str | None) -> Socket:
        """Connect; raises the service's problem where it refuses."""
        library = _library("sync")
        with _errors():
            # entered, since a connection alone is no longer what newer ones return
            return cls(library.connect(url, **_settings(url, authority, proxy)).__enter__())

    def send(self, message: bytes | str) -> None:
        """Send a message."""
        with _errors():
            self._connection.send(message)

    def receive(self, timeout: float | None) -> bytes | str | None:
        """Return the next message; None: there is none within ``timeout`` seconds."""
        with _errors():
            try:
                message: bytes | str = self._connection.recv(timeout)
            except TimeoutError:
                return None
            return message

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


AsyncLock = anyio.Lock
Lock = threading.Lock


def async_last_words(seconds: float) -> AbstractContextManager[object]:
    """Give what is said at the end so many seconds, even in a task that was canceled."""
    return anyio.move_on_after(seconds, shield=True)


def last_words(_seconds: float) -> AbstractContextManager[object]:
    """Do the same where calls block, which nothing cancels."""
    return nullcontext()


def _library(flavour: str) -> ModuleType:
    """Return the library's client, which only live sessions need."""
    try:
        if flavour == "sync":
            from websockets.sync import client as blocking

            return blocking
        from websockets.asyncio import client as awaited

        return awaited
    except ImportError as error:
        detail = "live sessions need the package websockets: pip install 'myoface[live]'"
        raise ApiError({"code": MISSING, "detail": detail}) from error


def _settings(url: str, authority: ssl.SSLContext | bool, proxy: str | None) -> dict[str, Any]:
    context = authority if isinstance(authority, ssl.SSLContext) else None
    own = {"ssl": context} if url.startswith("wss:") and context else {}
    return {
        **own,
        "proxy": proxy,
        "open_timeout": OPENS_WITHIN,
        "max_size": None,  # of one's own service
        "compression": None,
    }


@contextmanager
def _errors() -> Iterator[None]:
    """Turn what the library raises into an :class:`ApiError`."""
    from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

    try:
        yield
    except InvalidStatus as error:
        raise ApiError(_problem(error.response)) from error
    except ConnectionClosed as error:
        code, reason = (error.rcvd.code, error.rcvd.reason) if error.rcvd else (1006, "")
        detail = f"the connection was closed: {reason or code}"
        raise ApiError({"code": CLOSED, "detail": detail, "close": code}) from error
    except (WebSocketException, OSError) as error:
        detail = f"no answer: {str(error) or type(error).__name__}"
        raise ApiError({"code": UNREACHABLE, "detail": detail}) from error


def _problem(response: Any) -> dict[str, Any]:
    """Return the problem document of a service that refused to connect."""
    try:
        found = json.loads(response.body or b"")
    except ValueError:
        found = None
    if isinstance(found, dict) and isinstance(found.get("code"), str):
        return found
    detail = f"the service answered {response.status_code}"
    return {"code": UNREACHABLE, "detail": detail, "status": response.status_code}
