"""The proxy between this machine and a service, if there is one."""

from __future__ import annotations

from importlib.util import find_spec
from urllib.parse import urlsplit
from urllib.request import getproxies, proxy_bypass

import httpx

from myoface.client.credentials import is_loopback
from myoface.errors import ApiError

BAD_PROXY = "client.proxy"


def proxy_for(url: str, given: str | None) -> httpx.Proxy | None:
    """Return the proxy that requests to ``url`` go by: ``given``, or the environment's.

    The environment's is that of ``HTTPS_PROXY``, ``HTTP_PROXY`` or ``ALL_PROXY``, in small letters
    too, but not for hosts in ``NO_PROXY``; on Windows and macOS also that of the system. A service
    on this machine has none.

    Raises
    ------
    ApiError
        With ``client.proxy`` if it is no address of a proxy.
    """
    address = given or _from_environment(url)
    if not address:
        return None
    if "://" not in address:
        address = f"http://{address}"
    try:
        proxy = httpx.Proxy(address)
        # A # / or ? in a password ends the host before it
        is_cut = "@" in proxy.url.fragment or b"@" in proxy.url.raw_path
    except (ValueError, httpx.InvalidURL):
        proxy = None
    if proxy is None or is_cut or not proxy.url.host:
        # What httpx says may have a part of the password in it, also as an error's cause
        detail = (
            f"{_without_password(address)!r} is no address of a proxy, which is such as "
            "http://proxy.studio:3128; in a password write # / ? as %23 %2F %3F"
        )
        raise ApiError({"code": BAD_PROXY, "detail": detail})
    if proxy.url.scheme.startswith("socks") and find_spec("socksio") is None:
        detail = f"{told(proxy)} needs the package socksio: pip install socksio"
        raise ApiError({"code": BAD_PROXY, "detail": detail})
    return proxy


def told(proxy: httpx.Proxy) -> str:
    """Return a proxy's address as it may be shown: without a password."""
    return f"{proxy.url.scheme}://{proxy.url.netloc.decode('ascii').rpartition('@')[2]}"


def _from_environment(url: str) -> str | None:
    parts = urlsplit(url)
    host = parts.hostname or ""
    known = getproxies()
    if is_loopback(host) or not known or proxy_bypass(parts.netloc.rpartition("@")[2]):
        return None
    return known.get(parts.scheme) or known.get("all")


def _without_password(address: str) -> str:
    scheme, _, rest = address.partition("://")
    return f"{scheme}://{rest.rpartition('@')[2]}"
