"""Views of uploads, and tus's packing of an upload's metadata."""

from __future__ import annotations

import base64
import binascii
import hashlib
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from service.errors import Problem
from service.schemas import View
from service.store.models import Upload

LONGEST_NAME = 255


class UploadView(View):
    """An upload: bytes received so far (`offset`) of `size`; `sha256` is that of the bytes sent."""

    id: str
    filename: str
    size: int
    offset: int
    sha256: str | None
    state: Literal["open", "complete"]
    created_at: datetime
    expires_at: datetime

    @classmethod
    def of(cls, upload: Upload) -> UploadView:
        """Show an upload."""
        return cls(
            id=upload.id,
            filename=upload.filename,
            size=upload.size,
            offset=upload.offset,
            sha256=upload.sent_sha256 or upload.sha256,
            state="complete" if upload.complete else "open",
            created_at=upload.created_at,
            expires_at=upload.expires_at,
        )


@dataclass(frozen=True)
class Checksum:
    """A digest that bytes must have."""

    algorithm: str
    digest: bytes


def parse_checksum(header: str | None, algorithms: tuple[str, ...]) -> Checksum | None:
    """Read ``Upload-Checksum``: an algorithm and a base64 digest."""
    if header is None:
        return None
    algorithm, _, digest = header.partition(" ")
    if algorithm not in algorithms:
        raise Problem(
            400,
            "upload.checksum_algorithm",
            f"unknown checksum algorithm {algorithm!r}",
            expected=list(algorithms),
        )
    checksum = Checksum(algorithm, _decode(digest, "Upload-Checksum"))
    if len(checksum.digest) != hashlib.new(algorithm).digest_size:
        raise Problem(400, "upload.metadata", f"that is no {algorithm}", found=digest)
    return checksum


def parse_metadata(header: str) -> tuple[str, str | None]:
    """Read ``Upload-Metadata``; returns the file name and the sha256 of the whole file, if given.

    The name is kept for people (errors name it), so it must be a plain one.
    """
    pairs = [pair.strip().partition(" ")[::2] for pair in header.split(",") if pair.strip()]
    values = {key: _decode(value, "Upload-Metadata") for key, value in pairs}
    if len(values) != len(pairs):
        raise Problem(400, "upload.metadata", "Upload-Metadata has a key twice")
    try:
        name = values.get("filename", b"").decode()
        sha256 = values["sha256"].decode().lower() if "sha256" in values else None
    except UnicodeDecodeError as error:
        raise Problem(400, "upload.metadata", "Upload-Metadata is not UTF-8") from error
    plain = name.isprintable() and not set(name) & set("/\\") and name not in ("", ".", "..")
    if not plain or len(name.encode()) > LONGEST_NAME:
        raise Problem(
            400,
            "upload.filename",
            "Upload-Metadata must hold a plain filename, without folders",
            found=name[:LONGEST_NAME],
        )
    if sha256 is not None and (len(sha256) != 64 or set(sha256) - set("0123456789abcdef")):
        raise Problem(400, "upload.metadata", "sha256 must be 64 hexadecimal digits", found=sha256)
    return name, sha256


def _decode(text: str, header: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise Problem(400, "upload.metadata", f"{header} is not base64", found=text) from error
