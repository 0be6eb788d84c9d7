"""Which API key a client uses when it is given none."""

from __future__ import annotations

import os
from urllib.parse import urlsplit

from service.access.bootstrap import is_loopback
from service.settings import Settings

VARIABLE = "MYOFACE_API_KEY"


def key_for(url: str) -> str | None:
    """Return the key in ``MYOFACE_API_KEY``, else this machine's own if ``url`` is this machine.

    The service's first start leaves that one in its data folder, where only its owner can read it.
    """
    if given := os.environ.get(VARIABLE):
        return given
    if not is_loopback(urlsplit(url).hostname or ""):
        return None
    try:
        return Settings().admin_key.read_text()
    except OSError:
        return None


def headers_for(url: str, key: str | None) -> dict[str, str]:
    """Return the headers of a client of ``url``, with ``key`` or the one there is for it."""
    found = key or key_for(url)
    return {"Authorization": f"Bearer {found}"} if found else {}
