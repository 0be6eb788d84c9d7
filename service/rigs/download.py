"""Sending a stored file, or a range of it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import NamedTuple
from urllib.parse import quote

from fastapi import Request, Response
from fastapi.responses import StreamingResponse

from service.errors import Problem, lost, not_found
from service.store.database import Store
from service.store.integrity import LostFileError, known_fault, note_fault, open_checked
from service.store.models import Artifact

PAGE = "text/html"
# A stored page may show itself in a browser, and do nothing in this origin's name
POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; sandbox allow-downloads"

RANGE = re.compile(r"bytes=(\d{0,18})-(\d{0,18})")


class Span(NamedTuple):
    """The bytes from ``start`` to before ``end``."""

    start: int
    end: int


def send(artifact: Artifact, store: Store, request: Request) -> Response:
    """Return the response to a GET or HEAD of an artifact: the file, a range, or 304.

    Raises
    ------
    Problem
        404 if the file is being deleted, 410 if it is lost or damaged, 416 for a range that it does
        not have.
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
        _blocks(artifact, store, request, Span(start, end)),
        206 if span else 200,
        headers=headers,
        media_type=artifact.media_type,
    )


def _blocks(artifact: Artifact, store: Store, request: Request, span: Span) -> Iterator[bytes]:
    """Open the file, so that one that is lost or damaged is known before the response begins."""
    sha256 = artifact.sha256
    is_whole = span == Span(0, artifact.size)
    try:
        if fault := known_fault(store, sha256):
            raise LostFileError(sha256, fault)
        if request.method == "GET" and is_whole:
            return _noting(open_checked(store.files, sha256), store)
        if store.files.size(sha256) != artifact.size:
            raise LostFileError(sha256, "damaged")
        return store.files.open(sha256, *span) if request.method == "GET" else iter(())
    except FileNotFoundError:
        raise _lost(artifact, store, LostFileError(sha256, "lost")) from None
    except LostFileError as error:
        raise _lost(artifact, store, error) from error


def _noting(blocks: Iterator[bytes], store: Store) -> Iterator[bytes]:
    """Cut off a large file whose end shows that it is damaged: the next request is refused."""
    try:
        yield from blocks
    except LostFileError as error:
        note_fault(store, error.sha256, error.fault)
        raise


def _lost(artifact: Artifact, store: Store, error: LostFileError) -> Problem:
    """Return the problem of a file that cannot be sent, unless it is being deleted."""
    with store.read() as session:
        if session.get(Artifact, artifact.id) is None:
            return not_found("artifact", artifact.id)
    note_fault(store, error.sha256, error.fault)
    return lost(artifact.name, error.fault, artifact_id=artifact.id)


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
