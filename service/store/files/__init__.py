"""Content-addressed files: the name is the sha256, so a file never changes and is stored once."""

from __future__ import annotations

from pathlib import Path

from service.store.files.base import (
    Blob,
    DamagedFileError,
    Files,
    LargerFileError,
    StoredFile,
    UnreachableError,
)
from service.store.files.folder import FolderFiles

__all__ = [
    "Blob",
    "DamagedFileError",
    "Files",
    "FolderFiles",
    "LargerFileError",
    "StoredFile",
    "UnreachableError",
    "files_at",
]


def files_at(place: Path | str) -> Files:
    """Return the files in a folder, or in a bucket: ``s3://bucket/prefix?endpoint=...&region=...``.

    Raises
    ------
    ValueError
        If an S3 address names no bucket.
    """
    if isinstance(place, str) and place.startswith("s3://"):
        from service.store.files.s3 import S3Files  # boto3 is an extra

        return S3Files.at(place)
    return FolderFiles(Path(place))
