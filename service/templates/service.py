"""Template operations: create, count vertices, delete."""

from __future__ import annotations

import io
import re
from typing import Any
from zipfile import ZipFile

from sqlalchemy.orm import Session

from service.errors import Problem
from service.store.deletion import delete_template
from service.store.files import Files, UnreachableError
from service.store.integrity import LostFileError
from service.store.models import Deletion, Template
from service.templates import repository
from service.templates.schemas import NewTemplate
from service.uploads import repository as uploads
from solver.kinds import NOT_READABLE, check_directory, is_plainly_packed

SKIN = "skin_vertices.npy"
SHAPE = re.compile(rb"'shape': \((\d{1,9}), 3\)")
MOST_HEADER = 256  # bytes of an array's that are looked at


def create(session: Session, files: Files, new: NewTemplate) -> Template:
    """Make a template of an upload; a worker reads the file when a model is built."""
    upload = uploads.get_complete(session, new.upload_id)
    if not upload.filename.lower().endswith(".npz"):
        raise Problem(
            422,
            "template.format",
            f"{upload.filename}: a template is an .npz file",
            file=upload.filename,
            expected=[".npz"],
        )
    template = Template(
        name=new.name,
        filename=upload.filename,
        size=upload.size,
        sha256=upload.sha256,
        vertices=count_vertices(files, str(upload.sha256), upload.size),
    )
    session.add(template)
    session.flush()
    uploads.use(session, upload, template.id)
    return template


def delete(session: Session, template_id: str) -> Deletion:
    """Delete a template that no subject has."""
    template = repository.lock(session, template_id)
    if subjects := repository.subjects_of(session, template_id):
        raise Problem(
            409,
            "template.in_use",
            "subjects have this template",
            template_id=template_id,
            subject_ids=list(subjects),
        )
    return delete_template(session, template, "request")


def count_vertices(files: Files, sha256: str, size: int) -> int | None:
    """Return how many vertices a template's skin has by the header of that array; None: no idea.

    No array is unpacked: of the file are read its end, its list of members and one header.
    """
    try:
        stored = io.BufferedReader(_StoredFile(files, sha256, size))
        check_directory(stored)
        with ZipFile(stored) as archive:
            skin = archive.getinfo(SKIN)
            if not is_plainly_packed(skin):
                return None
            with archive.open(skin) as member:
                shape = SHAPE.search(member.read(MOST_HEADER))
    except UnreachableError:  # which says nothing of the template
        raise
    except (*NOT_READABLE, LostFileError, LookupError, ValueError):
        return None
    return int(shape[1]) if shape else None


class _StoredFile(io.RawIOBase):
    """A stored file whose parts can be read, as an archive's list of members asks for."""

    def __init__(self, files: Files, sha256: str, size: int) -> None:
        self._files = files
        self._sha256 = sha256
        self._size = size
        self._at = 0

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = 0) -> int:
        start = (0, self._at, self._size)[whence]
        self._at = max(0, start + offset)
        return self._at

    def readinto(self, buffer: Any) -> int:
        end = min(self._at + len(buffer), self._size)
        if end <= self._at:
            return 0
        content = b"".join(self._files.open(self._sha256, self._at, end))
        buffer[: len(content)] = content
        self._at += len(content)
        return len(content)
