"""The edge: what every request passes before a route sees it, whoever sent it."""

from __future__ import annotations

import gzip
import re
from functools import partial

from anyio import to_thread
from fastapi import FastAPI
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.access.keys import Keyring
from service.http.bodies import Bodies
from service.http.context import RequestContext
from service.http.security import Security
from service.settings import Settings

PACKED = frozenset({"application/json", "application/problem+json"})
# Bytes from which packing is worth it, and from which it would hold other requests up
LEAST_PACKED = 1 << 10
LONG = 1 << 16
REFUSAL = re.compile(r"q\s*=\s*0(\.0*)?")  # the weight of a coding that is not taken
LEVEL = 4  # of gzip's nine: lists say much twice, and shrink by any


def install(app: FastAPI, keyring: Keyring, settings: Settings) -> None:
    """Put the edge around ``app``; the last one added is the outermost."""
    app.add_middleware(Packing)
    app.add_middleware(
        Bodies, keyring=keyring, seconds=settings.receive_timeout, min_rate=settings.min_upload_rate
    )
    app.add_middleware(
        Security, allowed_hosts=settings.allowed_hosts, viewer_origins=settings.viewer_origins
    )
    app.add_middleware(RequestContext)


class Packing:
    """Packs JSON by gzip for who can unpack it.

    Stored files stay as they are: their ranges and their strong ETags are of their own bytes.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http" or not takes_gzip(
            Headers(scope=scope).get("accept-encoding", "")
        ):
            await self._app(scope, receive, send)
            return
        start: Message | None = None

        async def send_packed(message: Message) -> None:
            nonlocal start
            if message["type"] == "http.response.start" and _can_be_packed(message):
                start = message
                return
            if start is not None:
                body = message.get("body", b"")
                headers = MutableHeaders(scope=start)
                headers.add_vary_header("Accept-Encoding")
                if len(body) >= LEAST_PACKED and not message.get("more_body"):
                    body = await _pack(body)
                    headers["Content-Encoding"] = "gzip"
                    headers["Content-Length"] = str(len(body))
                    message = {**message, "body": body}
                await send(start)
                start = None
            await send(message)

        await self._app(scope, receive, send_packed)


def takes_gzip(accept_encoding: str) -> bool:
    """Return whether a client says that it can unpack gzip."""
    for part in accept_encoding.lower().split(","):
        coding, _, weight = part.partition(";")
        if coding.strip() == "gzip":
            return REFUSAL.fullmatch(weight.strip()) is None
    return False


def _can_be_packed(start: Message) -> bool:
    headers = Headers(scope=start)
    kind = headers.get("content-type", "").partition(";")[0]
    return kind in PACKED and not {"etag", "content-encoding", "content-range"} & set(headers)


async def _pack(body: bytes) -> bytes:
    pack = partial(gzip.compress, body, LEVEL, mtime=0)
    return await to_thread.run_sync(pack) if len(body) >= LONG else pack()
