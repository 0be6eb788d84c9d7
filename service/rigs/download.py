"""Sending a stored file, or a range of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple
from urllib.parse import quote

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from service.errors import Problem, not_found
from service.store.files import Files
from service.store.models import Artifact

PAGE = "text/html"
# A stored page may show itself in a browser, and do nothing in this origin's name
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; sandbox allow-downloads"

RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


class Span(NamedTuple):
    """The bytes from ``start`` to before ``end``."""

    start: int
    end: int


def send(artifact: Artifact, files: Files, request: Request) -> Response:
    """Return the response to a GET or HEAD of an artifact: the file, a range, or 304.

    Raises
    ------
    Problem
        404 if the file is being deleted, 416 for a range that it does not have.
    """
    tag = f'"{artifact.sha256}"'
    headers = {
        "ETag": tag,
        # A copy may be kept and used as long as the service says that it still has the file.
        "Cache-Control": "private, no-cache",
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": POLICY,
        "Accept-Ranges": "bytes",
        "Content-Disposition": _disposition(artifact),
    }
    if _has(request.headers.get("if-none-match", ""), tag):
        return Response(status_code=304, headers=headers)
    span = _range(artifact, tag, request)
    start, end = span or Span(0, artifact.size)
    headers["Content-Length"] = str(end - start)
    if span:
        headers["Content-Range"] = f"bytes {start}-{end - 1}/{artifact.size}"
    return StreamingResponse(
        _blocks(artifact, files, request, Span(start, end)),
        206 if span else 200,
        headers=headers,
        media_type=artifact.media_type,
    )


def _blocks(artifact: Artifact, files: Files, request: Request, span: Span) -> Iterator[bytes]:
    """Open the file, so that a missing one is known before the response begins."""
    if request.method == "HEAD":
        return iter(())
    try:
        return files.open(artifact.sha256, *span)
    except FileNotFoundError as error:
        raise not_found("artifact", artifact.id) from error


def _has(given: str, tag: str) -> bool:
    """Return whether a list of entity tags names this one."""
    known = {each.strip().removeprefix("W/") for each in given.split(",")}
    return bool(known & {tag, "*"})


def _range(artifact: Artifact, tag: str, request: Request) -> Span | None:
    """Return the range asked for; None: the whole file, also for several ranges or other units."""
    match = RANGE.fullmatch(request.headers.get("range", "").replace(" ", ""))
    if match is None or not any(match.groups()):
        return None
    if request.headers.get("if-range", tag) != tag:
        return None  # a part of another file
    size = artifact.size
    if match[1]:
        start, end = int(match[1]), min(int(match[2] or size) + 1, size)
    else:
        start, end = max(size - int(match[2]), 0), size
    if match[1] and match[2] and int(match[2]) < start:
        return None
    if start >= end:
        problem = Problem(
            416, "artifact.range", f"{artifact.name} has {size} bytes, and no such range"
        )
        problem.headers = {"Content-Range": f"bytes */{size}"}
        raise problem
    return Span(start, end)


def _disposition(artifact: Artifact) -> str:
    kind = "inline" if artifact.media_type == PAGE else "attachment"
    return f"{kind}; filename*=utf-8''{quote(artifact.name)}"
