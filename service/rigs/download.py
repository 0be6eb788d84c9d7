"""Sending a stored file, or a range of it."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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


class ByteRange(NamedTuple):
    """The bytes from ``start`` to before ``end``."""

    start: int
    end: int


@dataclass(frozen=True)
class Sendable(ABC):
    """Bytes for `send`; they stay the same while the ``tag`` (hex) does."""

    name: str
    media_type: str
    size: int
    tag: str

    @abstractmethod
    def check(self) -> None:
        """Raise the problem of what cannot be sent, as far as it shows without reading it."""

    @abstractmethod
    def blocks(self, span: ByteRange) -> Iterator[bytes]:
        """Give a part of it; what is known to be wrong is raised here, before the first block."""


@dataclass(frozen=True)
class StoredArtifact(Sendable):
    """A file that a job left, in the file store."""

    artifact: Artifact
    store: Store

    @classmethod
    def of(cls, artifact: Artifact, store: Store) -> StoredArtifact:
        """Return an artifact as it is sent."""
        about = artifact.name, artifact.media_type, artifact.size, artifact.sha256
        return cls(*about, artifact, store)

    def check(self) -> None:
        """See `Sendable`."""
        with self._problems():
            self._require_size()

    def blocks(self, span: ByteRange) -> Iterator[bytes]:
        """See `Sendable`: what is sent whole is compared with its name on the way."""
        sha256 = self.tag
        with self._problems():
            if span == ByteRange(0, self.size):
                return _noting(open_checked(self.store.files, sha256), self.store)
            self._require_size()
            return self.store.files.open(sha256, *span)

    def _require_size(self) -> None:
        if self.store.files.size(self.tag) != self.size:
            raise LostFileError(self.tag, "damaged")

    @contextmanager
    def _problems(self) -> Iterator[None]:
        """Make problems of the faults of the file, also of one that is known from before."""
        sha256 = self.tag
        try:
            if fault := known_fault(self.store, sha256):
                raise LostFileError(sha256, fault)
            yield
        except FileNotFoundError:
            raise _lost(self.artifact, self.store, LostFileError(sha256, "lost")) from None
        except LostFileError as error:
            raise _lost(self.artifact, self.store, error) from error


def send(content: Sendable, request: Request) -> Response:
    """Return the response to a GET or HEAD: all of it, a range, or 304.

    Raises
    ------
    Problem
        404 for a file that is being deleted, 410 if it is lost or damaged, 416 for a range that it
        does not have.
    """
    tag = f'"{content.tag}"'
    headers = {
        "ETag": tag,
        # A copy may be kept and used as long as the service says that it still has the file.
        "Cache-Control": "private, no-cache",
        "X-Content-Type-Options": "nosniff",
        "Content-Security-Policy": POLICY,
        "Accept-Ranges": "bytes",
        "Content-Disposition": _disposition(content),
    }
    if _has(request.headers.get("if-none-match", ""), tag):
        return Response(status_code=304, headers=headers)
    part = _range(content, tag, request)
    span = part or ByteRange(0, content.size)
    headers["Content-Length"] = str(span.end - span.start)
    if part:
        headers["Content-Range"] = f"bytes {span.start}-{span.end - 1}/{content.size}"
    body: Iterator[bytes] = iter(())
    if request.method == "GET":
        body = content.blocks(span)
    else:
        content.check()
    return StreamingResponse(
        body, 206 if part else 200, headers=headers, media_type=content.media_type
    )


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


def _range(content: Sendable, tag: str, request: Request) -> ByteRange | None:
    """Return the range asked for; None: the whole file, also for several ranges or other units."""
    match = RANGE.fullmatch(request.headers.get("range", "").replace(" ", ""))
    if match is None or not any(match.groups()):
        return None
    if request.headers.get("if-range", tag) != tag:
        return None  # a part of another file
    size = content.size
    if match[1]:
        start = int(match[1])
        end = min(int(match[2] or size) + 1, size)
    else:
        start = max(size - int(match[2]), 0)
        end = size
    if match[1] and match[2] and int(match[2]) < start:
        return None
    if start >= end:
        problem = Problem(
            416, "artifact.range", f"{content.name} has {size} bytes, and no such range"
        )
        problem.headers = {"Content-Range": f"bytes */{size}"}
        raise problem
    return ByteRange(start, end)


def _disposition(content: Sendable) -> str:
    kind = "inline" if content.media_type == PAGE else "attachment"
    return f"{kind}; filename*=utf-8''{quote(content.name)}"
