"""Sizes that a row does not have: those of files that a version before quotas counted them left.

A worker that is not upgraded yet goes on leaving some.
"""

from __future__ import annotations

from sqlalchemy import select, update

from service.store.files import Files
from service.store.models import Capture, FrameChunk
from service.store.store import Store

BATCH = 200
UNMEASURED = (
    (Capture.landmarks_sha256, Capture.landmarks_size),
    (FrameChunk.sha256, FrameChunk.size),
)


def measure(store: Store) -> None:
    """Write down the sizes of some files that have none in the tables; one that is lost has 0."""
    for sha256, size in UNMEASURED:
        with store.read() as session:
            unknown = select(sha256).where(sha256.is_not(None), size.is_(None))
            files = session.scalars(unknown.distinct().limit(BATCH)).all()
        for file in filter(None, files):
            found = _size(store.files, file)
            with store.write() as session:
                session.execute(
                    update(sha256.class_)
                    .where(sha256 == file, size.is_(None))
                    .values({size.key: found})
                )


def _size(files: Files, sha256: str) -> int:
    try:
        return files.size(sha256)
    except FileNotFoundError:
        return 0
