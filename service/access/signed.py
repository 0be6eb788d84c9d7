"""Signed URLs: a path that opens for a few minutes to whoever has it, without a key.

The signature binds the path, the tenant and the end; there is nothing to look up.
"""

from __future__ import annotations

import base64
import hmac
import re
import time
from typing import Annotated, NamedTuple

from fastapi import Depends, Query, Request

from service.access.principal import (
    Credentials,
    Principal,
    Scope,
    note_authenticated,
    principal,
    require,
)
from service.errors import Problem

TOKEN = re.compile(r"([0-9a-z-]{1,36})\.([0-9]{1,12})\.([0-9A-Za-z_-]{43})")
# Stands in the place of a key's id
BEARER = "signed-url"
# Of a request's state: it is served by its URL's signature alone, no key counts
SIGNED = "is_signed"
PARAMETER = "signed"


class Refusals(NamedTuple):
    """Code and detail of the problems of a token that is wrong, and of one that is old."""

    invalid: tuple[str, str]
    expired: tuple[str, str]


OF_URLS = Refusals(
    ("url.invalid", "the URL is not as it was signed"),
    ("url.expired", "the URL's time is over: ask for another"),
)


class Signer:
    """Signs paths with a key made of the service's ``secret``, another one for each ``purpose``."""

    def __init__(
        self, secret: bytes, purpose: bytes = b"signed urls", refusals: Refusals = OF_URLS
    ) -> None:
        self._key = hmac.digest(secret, purpose, "sha256")
        self._refusals = refusals

    def sign(self, path: str, tenant_id: str, until: int) -> str:
        """Return ``path`` with what lets anybody read it until a moment (Unix time)."""
        return f"{path}?{PARAMETER}={self.token(path, tenant_id, until)}"

    def token(self, path: str, tenant_id: str, until: int) -> str:
        """Return what `verify` takes for ``path`` until a moment (Unix time)."""
        return f"{tenant_id}.{until}.{self._signature(path, tenant_id, until)}"

    def verify(self, path: str, token: str) -> str:
        """Return the tenant in whose name ``path`` may be read.

        Raises
        ------
        Problem
            403 for a token that was not made for this path, or whose time is over.
        """
        match = TOKEN.fullmatch(token)
        if match is None:
            raise Problem(403, *self._refusals.invalid)
        tenant_id = match[1]
        until = int(match[2])
        signature = match[3]
        if not hmac.compare_digest(signature, self._signature(path, tenant_id, until)):
            raise Problem(403, *self._refusals.invalid)
        if until <= time.time():
            raise Problem(403, *self._refusals.expired)
        return tenant_id

    def _signature(self, path: str, tenant_id: str, until: int) -> str:
        text = f"{path}\n{tenant_id}\n{until}".encode()
        digest = hmac.digest(self._key, text, "sha256")
        return base64.urlsafe_b64encode(digest).decode().rstrip("=")


def _file_reader(
    request: Request,
    credentials: Credentials,
    signed: Annotated[
        str | None, Query(max_length=100, description="of a signed URL, in place of a key")
    ] = None,
) -> Principal:
    if signed is None:
        return require(Scope.READ, principal(request, credentials))
    setattr(request.state, SIGNED, True)
    tenant_id = request.app.state.signer.verify(request.url.path, signed)
    note_authenticated(request, tenant_id)
    request.state.rate = request.app.state.rates.check(f"{BEARER}:{tenant_id}", tenant_id)
    return Principal(tenant_id, BEARER, frozenset({Scope.READ}), request.state.request_id)


# The caller that may read the file at the request's path, by a key or a signature
FileReader = Annotated[Principal, Depends(_file_reader)]
