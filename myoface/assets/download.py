"""A download over HTTP that goes on where it broke off, also in a later run."""

from __future__ import annotations

import time
from pathlib import Path

import httpx

from myoface.client.files import Transferred, ignore_transfer
from myoface.client.retry import Backoff, require_success, transport_errors
from myoface.errors import ApiError


def download(
    http: httpx.Client,
    url: str,
    part: Path,
    *,
    size: int | None = None,
    resumable: bool = False,
    progress: Transferred = ignore_transfer,
) -> None:
    """Fetch ``url`` into ``part``, which may hold the beginning already.

    A part is continued where the server says that the file is still the same (its ETag is kept in
    ``<part>.etag``) or where the caller will check the whole (``resumable``); otherwise it begins
    anew. ``size`` is the file's, where it is known: a connection that ends early is then noticed
    even if the server does not say how much it sends.

    Raises :class:`ApiError` (``client.unreachable``, ``http.404`` ...) after several attempts.
    """
    tag = part.with_name(f"{part.name}.etag")
    backoff = Backoff()
    complete, furthest = False, 0
    while not complete:
        have = _kept(part, tag, resumable, size)
        if have == size:
            break
        try:
            with (
                transport_errors(),
                http.stream("GET", url, headers=_headers(have, tag)) as response,
            ):
                if response.status_code == httpx.codes.REQUESTED_RANGE_NOT_SATISFIABLE and have:
                    part.unlink()  # it is not longer than the part: begin anew
                    continue
                if response.is_error:
                    response.read()
                partial = require_success(response).status_code == httpx.codes.PARTIAL_CONTENT
                _remember(response, tag)
                total = size or _total(response, have if partial else 0)
                with part.open("ab" if partial else "wb") as stream:
                    for block in response.iter_raw():
                        stream.write(block)
                        progress(stream.tell(), total or stream.tell())
                        if stream.tell() > furthest:  # else a server could cut us off for ever
                            furthest = stream.tell()
                            backoff.reset()
        except ApiError as error:
            time.sleep(backoff.pause_if_transient(error))
            continue
        arrived = part.stat().st_size
        complete = size is None or arrived >= size
        if not complete:
            detail = f"{url} ended after {arrived} of {size} bytes"
            truncated = ApiError({"code": "client.truncated", "detail": detail})
            time.sleep(backoff.pause_after(truncated))
    tag.unlink(missing_ok=True)


def _kept(part: Path, tag: Path, resumable: bool, size: int | None) -> int:
    """Return how many bytes of the part are of use; a part of no use is deleted."""
    have = part.stat().st_size if part.exists() else 0
    if have and ((size is not None and have > size) or not (resumable or tag.exists())):
        part.unlink()
        return 0
    return have


def _headers(have: int, tag: Path) -> dict[str, str]:
    # What is stored is the file itself, not a compressed form of it: ranges count its bytes.
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if tag.exists():
            headers["If-Range"] = tag.read_text(encoding="utf-8")
    return headers


def _remember(response: httpx.Response, tag: Path) -> None:
    etag = response.headers.get("ETag", "")
    if etag.startswith('"'):  # a weak one (W/"...") does not promise the same bytes
        tag.write_text(etag, encoding="utf-8")
    else:
        tag.unlink(missing_ok=True)


def _total(response: httpx.Response, before: int) -> int | None:
    length = response.headers.get("Content-Length", "")
    return before + int(length) if length.isdigit() else None
