"""Find stored files that are lost or damaged, and name what they belong to."""

from __future__ import annotations

import errno
import hashlib
from collections import defaultdict
from collections.abc import Collection, Iterator
from typing import Literal

from sqlalchemy import or_, select
from sqlalchemy.orm import Session

from service.store.files import Files, UnreachableError
from service.store.models import Artifact, Capture, FrameChunk, Template, Upload

Fault = Literal["lost", "damaged"]
# Files that are looked up in one query: SQLite takes 32,766 parameters, older ones 999
AT_ONCE = 400


def find_fault(files: Files, sha256: str) -> Fault | None:
    """Read a file and compare it with its name; None: it is whole.

    Raises
    ------
    UnreachableError
        If the store does not answer, which says nothing about the file.
    """
    digest = hashlib.sha256()
    try:
        for block in files.open(sha256):
            digest.update(block)
    except FileNotFoundError:
        return "lost"
    except UnreachableError:
        raise
    except OSError as error:
        if error.errno != errno.EIO:
            raise
        return "damaged"  # a disk that cannot read its sectors any more
    return None if digest.hexdigest() == sha256 else "damaged"


def holders(session: Session, files: Collection[str]) -> dict[str, list[str]]:
    """Return what each of some files belongs to, in words: names of captures, ids of the rest."""
    found: dict[str, list[str]] = defaultdict(list)
    listed = sorted(files)
    for start in range(0, len(listed), AT_ONCE):
        for sha256, words in _holders(session, listed[start : start + AT_ONCE]):
            found[sha256].append(words)
    return found


def _holders(session: Session, files: Collection[str]) -> Iterator[tuple[str, str]]:
    scans = or_(Capture.sha256.in_(files), Capture.landmarks_sha256.in_(files))
    for capture in session.scalars(select(Capture).where(scans)):
        words = f"capture {capture.name} of subject {capture.subject_id}"
        if capture.sha256 in files:
            yield capture.sha256, words
        if capture.landmarks_sha256 and capture.landmarks_sha256 in files:
            yield capture.landmarks_sha256, f"landmarks of {words}"
    for template in session.scalars(select(Template).where(Template.sha256.in_(files))):
        yield template.sha256, f"template {template.id}"
    for artifact in session.scalars(select(Artifact).where(Artifact.sha256.in_(files))):
        yield artifact.sha256, f"{artifact.name} of job {artifact.job_id}"
    for chunk in session.scalars(select(FrameChunk).where(FrameChunk.sha256.in_(files))):
        yield chunk.sha256, f"frames {chunk.first} to {chunk.last} of job {chunk.job_id}"
    for upload in session.scalars(select(Upload).where(Upload.sha256.in_(files))):
        if upload.sha256 is not None:
            yield upload.sha256, f"upload {upload.id}"
