"""Routes of the page: the document at its paths, and its static files from the package."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import PurePosixPath
from typing import Annotated

from fastapi import APIRouter, Header, Response

from service.errors import Problem
from service.http import takes_gzip

# Paths at which the document is served; `static/js/routes.js` says which view shows at each
PATHS = (
    "/",
    "/queue",
    "/upload",
    "/subjects",
    "/subjects/{identifier}",
    "/jobs",
    "/jobs/{identifier}",
    "/rigs",
    "/rigs/{identifier}",
    "/markers/{identifier}",
    "/compare",
    "/health",
    "/webhooks",
    "/webhooks/{identifier}",
    "/audit",
    "/api",
    "/sign-in",
)

POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "connect-src 'self'",
        "img-src 'self' data: blob:",
        "media-src blob:",
        "font-src 'self'",
        "frame-src 'self'",
        "base-uri 'none'",
        "form-action 'none'",
        "frame-ancestors 'none'",
    )
)

# Types of what is served; a file of another kind is not. All are text, so all are packed.
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}

HEADERS = {
    "Cache-Control": "no-cache",  # kept, but asked for again: a 304 unless the release changed
    "Content-Security-Policy": POLICY,
    "Vary": "Accept-Encoding",
}


@dataclass(frozen=True)
class StaticFile:
    """A static file, as it is and packed by gzip; ``digest`` is of its content."""

    content: bytes
    packed: bytes
    digest: str
    media_type: str

    @classmethod
    def of(cls, content: bytes, media_type: str) -> StaticFile:
        """Pack what is sent again and again."""
        return cls(
            content=content,
            packed=gzip.compress(content, mtime=0),
            digest=hashlib.sha256(content).hexdigest()[:32],
            media_type=media_type,
        )


router = APIRouter(include_in_schema=False)

AcceptEncoding = Annotated[str, Header()]
IfNoneMatch = Annotated[str, Header()]


@router.api_route("/static/{path:path}", methods=["GET", "HEAD"])
def static(
    path: str, accept_encoding: AcceptEncoding = "", if_none_match: IfNoneMatch = ""
) -> Response:
    """Send a static file."""
    asset = assets().get(path)
    if asset is None:
        raise Problem(404, "page.unknown", "the page has no such file")
    return send_static(asset, accept_encoding, if_none_match)


def document(accept_encoding: AcceptEncoding = "", if_none_match: IfNoneMatch = "") -> Response:
    """Send the document; what it shows depends on the path that it is opened at."""
    return send_static(assets()["index.html"], accept_encoding, if_none_match)


for _path in PATHS:
    router.add_api_route(_path, document, methods=["GET", "HEAD"])


@cache
def assets() -> dict[str, StaticFile]:
    """Return the static files by their path; about a megabyte, read once."""
    root = resources.files(__package__).joinpath("static")
    return {
        str(path): StaticFile.of(file.read_bytes(), TYPES[path.suffix])
        for path, file in _files(root, PurePosixPath())
    }


def _files(folder: Traversable, at: PurePosixPath) -> list[tuple[PurePosixPath, Traversable]]:
    found = []
    for entry in sorted(folder.iterdir(), key=lambda entry: entry.name):
        path = at / entry.name
        if entry.is_dir():
            found += _files(entry, path)
        elif path.suffix in TYPES:
            found.append((path, entry))
    return found


def send_static(asset: StaticFile, accept_encoding: str, if_none_match: str) -> Response:
    """Send a file, packed if the browser can unpack; the two forms have different ETags."""
    packs = takes_gzip(accept_encoding)
    etag = f'"{asset.digest}{"-gzip" if packs else ""}"'
    headers = {**HEADERS, "ETag": etag, "Content-Type": asset.media_type}
    if etag in {tag.strip().removeprefix("W/") for tag in if_none_match.split(",")}:
        return Response(status_code=304, headers=headers)
    if packs:
        headers["Content-Encoding"] = "gzip"
    return Response(asset.packed if packs else asset.content, headers=headers)
