"""Stored files that rot or vanish: a job that reads one fails once, and says which it was."""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import select

from service.store.files import Files, FolderFiles
from service.store.files.s3 import S3Files
from service.store.models import Capture
from tests.campaigns.chaos.stage import Stage


def flip_file(stage: Stage) -> bool:
    """Flip a bit of a scan, and submit a job that reads it."""
    return _spoil(stage, _flip)


def lose_file(stage: Stage) -> bool:
    """Remove a scan, and submit a job that reads it."""
    return _spoil(stage, _lose)


def _spoil(stage: Stage, how: Callable[[Files, str], None]) -> bool:
    subject = stage.studio.subject()
    scan = stage.studio.raw(subject, f"spoilt{len(stage.spoilt)}")
    with stage.store.read() as session:
        sha256 = session.scalars(select(Capture.sha256).where(Capture.id == scan)).one()
    how(stage.store.files, sha256)
    stage.gone.add(sha256)
    stage.spoilt.append(stage.studio.submit("check_scan", subject, captures=[scan]))
    return True


def _flip(files: Files, sha256: str) -> None:
    content = bytearray(files.read(sha256))
    content[0] ^= 1
    if isinstance(files, FolderFiles):
        path = files.path(sha256)
        path.chmod(0o600)
        path.write_bytes(content)
    elif isinstance(files, S3Files):
        place = {"Bucket": files._bucket, "Key": files._key(sha256)}
        files._client.put_object(**place, Body=bytes(content))


def _lose(files: Files, sha256: str) -> None:
    files.put_aside(sha256)
    files.remove(sha256)
