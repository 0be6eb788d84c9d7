"""Find, remember and name stored files that are lost or damaged."""

from __future__ import annotations

import errno
import hashlib
from collections import defaultdict
from collections.abc import Collection, Iterator
from contextlib import suppress
from itertools import chain
from typing import Literal

import structlog
from sqlalchemy import or_, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from service.store.database import Store, clock
from service.store.files import Files, UnreachableError
from service.store.models import Artifact, Capture, FileFault, FrameChunk, Job, Template, Upload

Fault = Literal["lost", "damaged"]
# Files that are looked up in one query: SQLite takes 32,766 parameters, older ones 999
AT_ONCE = 400
# Bytes of a file that are read before the first of them is given
AHEAD = 1 << 20

log = structlog.get_logger()


class LostFileError(Exception):
    """A stored file is gone, or its bytes are not those that its name says."""

    def __init__(self, sha256: str, fault: Fault) -> None:
        super().__init__(f"the stored file {sha256} is {fault}")
        self.sha256 = sha256
        self.fault = fault


def open_checked(files: Files, sha256: str) -> Iterator[bytes]:
    """Give a file's bytes; the last ones only after all were compared with its name.

    A file of up to `AHEAD` bytes is compared before this returns.

    Raises
    ------
    LostFileError
        If it is lost or damaged: at once, or of a larger file in place of the last bytes.
    """
    blocks = _read_and_compare(files, sha256)
    first = []
    read = 0
    for block in blocks:
        first.append(block)
        read += len(block)
        if read >= AHEAD:
            break
    return chain(first, blocks)


def find_fault(files: Files, sha256: str) -> Fault | None:
    """Read a file and compare it with its name; None: it is whole.

    Raises
    ------
    UnreachableError
        If the store does not answer, which says nothing about the file.
    """
    try:
        for _ in _read_and_compare(files, sha256):
            pass
    except LostFileError as error:
        return error.fault
    return None


def _read_and_compare(files: Files, sha256: str) -> Iterator[bytes]:
    digest = hashlib.sha256()
    held_back = b""
    try:
        for block in files.open(sha256):
            digest.update(block)
            if held_back:
                yield held_back
            held_back = block
    except FileNotFoundError as error:
        raise LostFileError(sha256, "lost") from error
    except OSError as error:
        if isinstance(error, UnreachableError) or error.errno != errno.EIO:
            raise
        raise LostFileError(sha256, "damaged") from error  # its sectors cannot be read
    if digest.hexdigest() != sha256:
        raise LostFileError(sha256, "damaged")
    yield held_back


def known_fault(store: Store, sha256: str) -> Fault | None:
    """Return what was found wrong with a file; one that is whole again is forgotten as faulty."""
    with store.read() as session:
        if session.get(FileFault, sha256) is None:
            return None
    fault = find_fault(store.files, sha256)
    note_fault(store, sha256, fault)
    return fault


def note_fault(store: Store, sha256: str, fault: Fault | None) -> None:
    """Remember what is wrong with a file, if the database takes it; None: nothing any more."""
    with suppress(SQLAlchemyError), store.write() as session:
        row = session.get(FileFault, sha256)
        if fault is None:
            if row is not None:
                session.delete(row)
            return
        if row is None:
            log.error("files.fault", sha256=sha256, fault=fault)
        session.merge(FileFault(sha256=sha256, fault=fault, found_at=clock(session)))


def faults(session: Session) -> dict[str, str]:
    """Return the files that are known to be lost or damaged, with which of the two."""
    return {row.sha256: row.fault for row in session.scalars(select(FileFault))}


def holders(session: Session, files: Collection[str]) -> dict[str, list[str]]:
    """Return what each of some files belongs to, in words: names of captures, ids of the rest."""
    found: dict[str, list[str]] = defaultdict(list)
    listed = sorted(files)
    for start in range(0, len(listed), AT_ONCE):
        for sha256, words in _holders(session, listed[start : start + AT_ONCE]):
            found[sha256].append(words)
    return found


def _holders(session: Session, files: Collection[str]) -> Iterator[tuple[str, str]]:
    columns = (Capture.sha256, Capture.landmarks_sha256, Capture.mask_sha256)
    scans = or_(*(column.in_(files) for column in columns))
    for capture in session.scalars(select(Capture).where(scans)):
        words = f"capture {capture.name} of subject {capture.subject_id}"
        if capture.sha256 in files:
            yield capture.sha256, words
        if capture.landmarks_sha256 and capture.landmarks_sha256 in files:
            yield capture.landmarks_sha256, f"landmarks of {words}"
        if capture.mask_sha256 and capture.mask_sha256 in files:
            yield capture.mask_sha256, f"mask of {words}"
    for template in session.scalars(select(Template).where(Template.sha256.in_(files))):
        yield template.sha256, f"template {template.id}"
    for artifact in session.scalars(select(Artifact).where(Artifact.sha256.in_(files))):
        yield artifact.sha256, f"{artifact.name} of job {artifact.job_id}"
    # with its job, of which a session sees only its tenant's
    chunks = select(FrameChunk).join(Job, Job.id == FrameChunk.job_id)
    for chunk in session.scalars(chunks.where(FrameChunk.sha256.in_(files))):
        yield chunk.sha256, f"frames {chunk.first} to {chunk.last} of job {chunk.job_id}"
    for upload in session.scalars(select(Upload).where(Upload.sha256.in_(files))):
        if upload.sha256 is not None:
            yield upload.sha256, f"upload {upload.id}"
