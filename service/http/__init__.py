"""The edge: what every request passes before a route sees it, whoever sent it."""

from __future__ import annotations

from fastapi import FastAPI

from service.access.keys import Keyring
from service.http.bodies import Bodies
from service.http.context import RequestContext
from service.http.security import Security
from service.settings import Settings


def install(app: FastAPI, keyring: Keyring, settings: Settings) -> None:
    """Put the edge around ``app``; the last one added is the outermost."""
    app.add_middleware(
        Bodies, keyring=keyring, seconds=settings.receive_timeout, min_rate=settings.min_upload_rate
    )
    app.add_middleware(
        Security, allowed_hosts=settings.allowed_hosts, viewer_origins=settings.viewer_origins
    )
    app.add_middleware(RequestContext)
