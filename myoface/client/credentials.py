"""The address, API key and certificate authority of a client that is given none."""

from __future__ import annotations

import ipaddress
import os
import ssl
from pathlib import Path
from urllib.parse import urlsplit

import httpx

from myoface.errors import ApiError

DEFAULT_URL = "http://127.0.0.1:8765"
KEY_VARIABLE = "MYOFACE_API_KEY"
CA_VARIABLE = "MYOFACE_CA"
NO_AUTHORITY = "client.ca"
BAD_ADDRESS = "client.address"
BAD_KEY = "client.key"
LAST_PORT = 65535


def read_address(given: str) -> str:
    """Return a service's address.

    Raises
    ------
    ApiError
        With ``client.address`` if it is none.
    """
    address = given.strip()
    try:
        url = httpx.URL(address)
        is_one = url.scheme in ("http", "https") and url.host and (url.port or 0) <= LAST_PORT
    except (httpx.InvalidURL, ValueError):
        is_one = False
    if is_one:
        return address
    told = address.rpartition("@")[2]  # no password
    detail = f"{told!r} is no address of a service: one such as {DEFAULT_URL} is needed"
    raise ApiError({"code": BAD_ADDRESS, "detail": detail})


def key_for(url: str) -> str | None:
    """Return the key in ``MYOFACE_API_KEY``, else this machine's own if ``url`` is this machine.

    The service's first start leaves that one in its data folder, where only its owner can read it.
    """
    if given := os.environ.get(KEY_VARIABLE):
        return given
    if not is_loopback(urlsplit(url).hostname or ""):
        return None
    data = os.environ.get("MYOFACE_DATA_DIR") or Path.home() / ".local" / "share" / "myoface"
    try:
        return (Path(data).expanduser() / "admin.key").read_text()
    except OSError:
        return None


def headers_for(url: str, key: str | None) -> dict[str, str]:
    """Return the headers of a client of ``url``, with ``key`` or the one there is for it."""
    found = (key or key_for(url) or "").strip()
    if not found.isascii() or not found.isprintable() or " " in found:
        detail = "the API key has characters that no key has: copy it again"
        raise ApiError({"code": BAD_KEY, "detail": detail})
    return {"Authorization": f"Bearer {found}"} if found else {}


def authority(ca: Path | str | None) -> ssl.SSLContext | bool:
    """Return the authority by which httpx verifies a service's certificate.

    It is the one in the PEM file ``ca``, or in the file that ``MYOFACE_CA`` names, and no other;
    without either the public authorities serve.

    Raises
    ------
    ApiError
        ``client.ca`` if the file holds no certificate that can be read.
    """
    path = ca or os.environ.get(CA_VARIABLE)
    if not path:
        return True
    try:
        return ssl.create_default_context(cafile=path)
    except OSError as error:  # ssl.SSLError is one
        reason = error.strerror or str(error)
        detail = f"no authority to verify the service with: {reason}"
        raise ApiError({"code": NO_AUTHORITY, "detail": detail, "file": str(path)}) from error


def is_loopback(host: str) -> bool:
    """Return True if only this machine reaches ``host``, a name or an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
