"""Files to and from the service: uploads and downloads that survive a broken connection."""

from __future__ import annotations

import base64
import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import httpx

from myoface.connection import Patience, checked, once, patiently
from myoface.errors import ApiError
from myoface.resources import Artifact, Upload

CHUNK_BYTES = 4 * 1024 * 1024

TUS = {"Tus-Resumable": "1.0.0"}
TUS_CONTENT = "application/offset+octet-stream"
# Another offset than the service has, or a broken connection's lock that is not free yet.
NOT_IN_STEP = frozenset({httpx.codes.CONFLICT, httpx.codes.LOCKED})

Transferred = Callable[[int, int], None]
"""Called with the bytes done and the bytes in all."""


def unheard(_done: int, _total: int, /) -> None:
    """Tell nobody how far a transfer is."""


def sha256_of(path: Path) -> str:
    """Return the hex digest of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def upload(
    http: httpx.Client,
    path: Path,
    *,
    resume: str | None = None,
    started: Callable[[str], None] | None = None,
    progress: Transferred = unheard,
) -> Upload:
    """Send a file by tus 1.0 and return the complete upload.

    ``resume`` continues an upload of the same file that was interrupted; ``started`` gets the id
    that a later ``resume`` needs. Raises :class:`ApiError`: ``client.changed`` if the file is not
    the one that ``resume`` began with, or the service's refusal.
    """
    size, digest = path.stat().st_size, sha256_of(path)
    if resume is None:
        upload_id = _start(http, path.name, size, digest)
    else:
        begun = _look(http, resume)
        if (begun.size, begun.sha256) != (size, digest):
            detail = f"{path.name} is not the file that upload {resume} began with"
            raise ApiError({"code": "client.changed", "detail": detail, "file": path.name})
        upload_id = begun.id
    if started is not None:
        started(upload_id)
    _send(http, f"/v1/uploads/{upload_id}", path, progress)
    return _look(http, upload_id)


def metadata(filename: str, sha256: str) -> str:
    """Return the ``Upload-Metadata`` header of a file."""
    values = {"filename": filename, "sha256": sha256}
    return ",".join(f"{k} {base64.b64encode(v.encode()).decode()}" for k, v in values.items())


def _start(http: httpx.Client, name: str, size: int, digest: str) -> str:
    headers = TUS | {"Upload-Length": str(size), "Upload-Metadata": metadata(name, digest)}
    response = once(http, "POST", "/v1/uploads", headers=headers)
    return response.headers["Location"].rstrip("/").rsplit("/", 1)[-1]


def _look(http: httpx.Client, upload_id: str) -> Upload:
    return Upload.model_validate(patiently(http, "GET", f"/v1/uploads/{upload_id}").json())


def _send(http: httpx.Client, url: str, path: Path, progress: Transferred) -> None:
    size = path.stat().st_size
    patience = Patience()
    offset: int | None = None  # None: ask the service how much it has
    with path.open("rb") as stream:
        while offset != size:
            with patience.retrying():
                if offset is None:
                    response = http.head(url, headers=TUS)
                else:
                    stream.seek(offset)
                    headers = TUS | {"Upload-Offset": str(offset), "Content-Type": TUS_CONTENT}
                    offset = None
                    response = http.patch(url, content=stream.read(CHUNK_BYTES), headers=headers)
                    if response.status_code in NOT_IN_STEP:
                        patience.failed(ApiError.from_response(response))
                        continue
                    patience.reset()
                offset = int(checked(response).headers["Upload-Offset"])
                progress(offset, size)


def part_path(path: Path, artifact: Artifact) -> Path:
    """Return where an unfinished download waits; another artifact's part has another name."""
    return path.with_name(f"{path.name}.{artifact.sha256[:12]}.part")


def download(
    http: httpx.Client, artifact: Artifact, path: Path, *, progress: Transferred = unheard
) -> None:
    """Fetch an artifact into ``path``, checked against its sha256.

    A part of the same artifact that is already there is continued; ``path`` itself appears only
    when the whole file is right. Raises :class:`ApiError` (``client.checksum``) if it is not.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    part = part_path(path, artifact)
    patience = Patience()
    part.touch()
    while (have := part.stat().st_size) < artifact.size:
        with patience.retrying():
            headers = {"Range": f"bytes={have}-", "If-Range": f'"{artifact.sha256}"'}
            with http.stream("GET", f"/v1/artifacts/{artifact.id}", headers=headers) as response:
                partial = checked(response).status_code == httpx.codes.PARTIAL_CONTENT
                with part.open("ab" if partial else "wb") as stream:
                    for block in response.iter_bytes():
                        stream.write(block)
                        progress(stream.tell(), artifact.size)
                        patience.reset()
    found = sha256_of(part)
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
