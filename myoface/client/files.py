"""Support for transfers that survive a broken connection: digests, tus headers, upload notes."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import anyio
import httpx

from myoface.errors import ApiError
from myoface.resources import Artifact
from myoface.values import NOT_OF_THE_API

TUS = {"Tus-Resumable": "1.0.0"}
TUS_CONTENT = "application/offset+octet-stream"
# Another offset than the service has, or a broken connection's lock that is not free yet.
OUT_OF_STEP = frozenset({httpx.codes.CONFLICT, httpx.codes.LOCKED, httpx.codes.REQUEST_TIMEOUT})
GONE = frozenset({httpx.codes.NOT_FOUND, httpx.codes.GONE})

# Longer than any service keeps an upload that nobody goes on with.
NOTES_KEPT_S = 7 * 24 * 3600

PLY_VERTICES = re.compile(rb"^element vertex (\d{1,9})\s*$", re.MULTILINE)
LONGEST_HEADER = 1 << 14  # bytes of a PLY that are looked at

# Called with the bytes done and the bytes in all.
Transferred = Callable[[int, int], None]


def ignore_transfer(_done: int, _total: int, /) -> None:
    """Tell nobody how far a transfer is."""


def sha256_of(path: Path) -> str:
    """Return the hex digest of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


async def async_sha256_of(path: Path) -> str:
    """Return the hex digest of a file, read in a thread."""
    return await anyio.to_thread.run_sync(sha256_of, path)


def count_vertices(path: Path) -> int | None:
    """Return how many vertices an OBJ or PLY has; None: of neither, or it shows none."""
    count = 0
    with path.open("rb") as stream:
        if path.suffix.lower() == ".obj":
            count = sum(line.startswith((b"v ", b"v\t")) for line in stream)
        elif path.suffix.lower() == ".ply":
            found = PLY_VERTICES.search(stream.read(LONGEST_HEADER))
            count = int(found[1]) if found else 0
    return count or None


async def async_count_vertices(path: Path) -> int | None:
    """Return how many vertices a mesh has, counted in a thread."""
    return await anyio.to_thread.run_sync(count_vertices, path)


def require_vertices(path: Path, found: int | None, expected: int) -> None:
    """Refuse a file that claims to be registered and has not the template's vertices."""
    if found in (None, expected):
        return
    raise ApiError(
        {
            "code": "client.topology",
            "detail": f"{path.name} has {found} vertices, and a registered scan has the template's "
            f"{expected}: send it as it is (without --registered), and the service registers it",
            "file": path.name,
            "expected": expected,
            "found": found,
        }
    )


def metadata(filename: str, sha256: str) -> str:
    """Return the ``Upload-Metadata`` header of a file."""
    values = {"filename": filename, "sha256": sha256}
    return ",".join(f"{k} {base64.b64encode(v.encode()).decode()}" for k, v in values.items())


def part_path(path: Path, artifact: Artifact) -> Path:
    """Return the file of an unfinished download; another artifact's part has another name."""
    return path.with_name(f"{path.name}.{artifact.sha256[:12]}.part")


def require_more(part: Path, had: int, artifact: Artifact) -> None:
    """Refuse an answer that brought nothing new of a file: a login page would be asked for ever."""
    if part.stat().st_size <= had:
        part.unlink()
        detail = f"{artifact.name}: what arrives is not the file"
        raise ApiError({"code": NOT_OF_THE_API, "detail": detail, "file": artifact.name})


def put_in_place(part: Path, path: Path, artifact: Artifact, found: str) -> None:
    """Move a complete download to ``path``; raise ``client.checksum`` if its digest is wrong."""
    if found == artifact.sha256:
        os.replace(part, path)
        return
    part.unlink()
    raise ApiError(
        {
            "code": "client.checksum",
            "detail": f"{artifact.name} arrived damaged",
            "file": artifact.name,
            "expected": artifact.sha256,
            "found": found,
        }
    )


def notes_folder() -> Path:
    """Return ``$MYOFACE_CACHE/uploads``, else ``~/.cache/myoface/uploads``."""
    cache = os.environ.get("MYOFACE_CACHE") or Path.home() / ".cache" / "myoface"
    return Path(cache) / "uploads"


class UploadNote:
    """The id of an unfinished upload, in the user's cache: a later run goes on with it.

    It is found by the service, the file's name and its bytes.
    """

    def __init__(self, url: str, filename: str, sha256: str) -> None:
        name = hashlib.sha256(f"{url}\n{filename}\n{sha256}".encode()).hexdigest()
        self._path = notes_folder() / name[:32]

    def read(self) -> str | None:
        """Return the upload's id; None: there is no such note."""
        try:
            return self._path.read_text(encoding="ascii").strip() or None
        except (OSError, UnicodeDecodeError):
            return None

    def write(self, upload_id: str) -> None:
        """Note an upload that has begun; a cache that cannot be written is no fault."""
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            _remove_old(self._path.parent)
            self._path.write_text(upload_id, encoding="ascii")

    def remove(self) -> None:
        """Forget an upload that is over."""
        with suppress(OSError):
            self._path.unlink(missing_ok=True)


def _remove_old(notes: Path) -> None:
    limit = time.time() - NOTES_KEPT_S
    for path in notes.iterdir():
        if path.stat().st_mtime < limit:
            path.unlink(missing_ok=True)
