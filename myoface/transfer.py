"""Files to and from the service: uploads and downloads that survive a broken connection."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import httpx

from myoface.connection import Flow, Open, Patience, Read, Send, Work, checked, once, patiently
from myoface.errors import ApiError
from myoface.resources import Artifact, Upload
from myoface.unfinished import Note

CHUNK_BYTES = 4 * 1024 * 1024

TUS = {"Tus-Resumable": "1.0.0"}
TUS_CONTENT = "application/offset+octet-stream"
# Another offset than the service has, or a broken connection's lock that is not free yet.
NOT_IN_STEP = frozenset({httpx.codes.CONFLICT, httpx.codes.LOCKED})
GONE = frozenset({httpx.codes.NOT_FOUND, httpx.codes.GONE})

Transferred = Callable[[int, int], None]
"""Called with the bytes done and the bytes in all."""


def unheard(_done: int, _total: int, /) -> None:
    """Tell nobody how far a transfer is."""


def sha256_of(path: Path) -> str:
    """Return the hex digest of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def upload(service: str, path: Path, *, progress: Transferred = unheard) -> Flow[Upload]:
    """Send a file by tus 1.0 to the service at the URL ``service``; returns the complete upload.

    An upload of the same file that was interrupted goes on, in a later run too: its id is noted in
    the user's cache until it is complete.
    """
    size, digest = path.stat().st_size, (yield Work(partial(sha256_of, path)))
    note = Note(service, path.name, digest)
    begun = yield from _begun(note)
    upload_id = begun or (yield from _start(path.name, size, digest))
    note.write(upload_id)
    yield from _send(f"/v1/uploads/{upload_id}", path, progress)
    note.remove()
    return (yield from _look(upload_id))


def metadata(filename: str, sha256: str) -> str:
    """Return the ``Upload-Metadata`` header of a file."""
    values = {"filename": filename, "sha256": sha256}
    return ",".join(f"{k} {base64.b64encode(v.encode()).decode()}" for k, v in values.items())


def _begun(note: Note) -> Flow[str | None]:
    """Return the upload that an earlier run began, if the service has it still."""
    upload_id = note.read()
    if upload_id is None:
        return None
    try:
        yield from _look(upload_id)
    except ApiError as error:
        if error.status not in GONE:
            raise
        return None
    return upload_id


def _start(name: str, size: int, digest: str) -> Flow[str]:
    headers = TUS | {"Upload-Length": str(size), "Upload-Metadata": metadata(name, digest)}
    response = yield from once("POST", "/v1/uploads", headers=headers)
    location: str = response.headers["Location"]
    return location.rstrip("/").rsplit("/", 1)[-1]


def _look(upload_id: str) -> Flow[Upload]:
    response = yield from patiently("GET", f"/v1/uploads/{upload_id}")
    return Upload.model_validate(response.json())


def _send(url: str, path: Path, progress: Transferred) -> Flow[None]:
    size = path.stat().st_size
    patience = Patience()
    offset: int | None = None  # None: ask the service how much it has
    with path.open("rb") as stream:
        while offset != size:
            try:
                if offset is None:
                    response = yield Send("HEAD", url, {"headers": TUS})
                else:
                    stream.seek(offset)
                    headers = TUS | {"Upload-Offset": str(offset), "Content-Type": TUS_CONTENT}
                    offset = None
                    chunk = {"content": stream.read(CHUNK_BYTES), "headers": headers}
                    response = yield Send("PATCH", url, chunk)
                    patience.reset()
                offset = int(checked(response).headers["Upload-Offset"])
                progress(offset, size)
            except ApiError as error:
                if error.status in NOT_IN_STEP:
                    yield from patience.wait(error)
                else:
                    yield from patience.bear(error)


def part_path(path: Path, artifact: Artifact) -> Path:
    """Return where an unfinished download waits; another artifact's part has another name."""
    return path.with_name(f"{path.name}.{artifact.sha256[:12]}.part")


def download(artifact: Artifact, path: Path, *, progress: Transferred = unheard) -> Flow[None]:
    """Fetch an artifact into ``path``, checked against its sha256.

    A part of the same artifact that is already there is continued; ``path`` itself appears only
    when the whole file is right. Raises :class:`ApiError` (``client.checksum``) if it is not.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = part_path(path, artifact)
    patience = Patience()
    part.touch()
    while (have := part.stat().st_size) < artifact.size:
        headers = {"Range": f"bytes={have}-", "If-Range": f'"{artifact.sha256}"'}
        try:
            response = yield Open("GET", f"/v1/artifacts/{artifact.id}", {"headers": headers})
            is_part = checked(response).status_code == httpx.codes.PARTIAL_CONTENT
            with part.open("ab" if is_part else "wb") as stream:
                while (block := (yield Read())) is not None:
                    stream.write(block)
                    progress(stream.tell(), artifact.size)
                    patience.reset()
        except ApiError as error:
            yield from patience.bear(error)
    found = yield Work(partial(sha256_of, part))
    if found != artifact.sha256:
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
    os.replace(part, path)
