"""A rig with all that is needed to go on with it, as one ZIP file that is made while it is sent.

Files are stored in it as they are, so where each of its bytes comes from is known before the first
is sent: its length, and any range. A file's CRC-32 stands before the file, for programs that unpack
a stream; so each is read once, and compared with its name, before a process sends it for the first
time. `rig.json`, the first file, names all others; the archive's tag is its sha256.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from threading import Lock
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.errors import Problem, lost, not_found
from service.rigs import repository
from service.rigs.download import ByteRange, Sendable
from service.rigs.schemas import ArtifactView, verdict_in
from service.store.database import Store
from service.store.deletion import waiting_receipt
from service.store.files import Files
from service.store.integrity import LostFileError, faults, known_fault, note_fault, open_checked
from service.store.models import Job, Rig, Subject, Template

NOTE = "rig.json"
TEMPLATE_FILE = "template.npz"
NPZ = "application/x-npz"
# Checksums that a process remembers, of files of any rig
MOST_CHECKSUMS = 50_000

# What `rig.json` says of a file: `ArtifactView` with the kind of its job
File = dict[str, Any]


@dataclass(frozen=True)
class Member:
    """A file of an archive: in the store, or ``content`` where it is made here."""

    name: str
    size: int
    sha256: str
    content: bytes | None = None


def archive_of(session: Session, rig: Rig, store: Store) -> RigArchive:
    """Return the archive of a rig, with the files that there are by now.

    Raises
    ------
    Problem
        410 if the rig waits for its subject's jobs to end, to be deleted with it.
    """
    if waiting_receipt(session, rig.subject_id) is not None:
        detail = "the rig is being deleted with its subject: it is not copied any more"
        raise Problem(410, "rig.deleting", detail, rig_id=rig.id, subject_id=rig.subject_id)
    model = session.get(Job, rig.model_job_id)
    used = _template_sha256(model)
    template = _template(session, used)
    files = [*_artifacts(session, rig, model), *_as_artifacts(template)]
    note = json.dumps(_note(session, rig, files, _about(template, used)), indent=1).encode() + b"\n"
    members = [
        Member(NOTE, len(note), hashlib.sha256(note).hexdigest(), note),
        *(Member(each["name"], each["size"], each["sha256"]) for each in files),
    ]
    return RigArchive.of(rig, members, store)


def _artifacts(session: Session, rig: Rig, model: Job | None) -> Iterator[File]:
    """Yield the files of the rig, of its preview and of its model; of one name the first."""
    preview = repository.preview(session, rig)
    found = [*([preview] if preview else []), *rig.artifacts, *(model.artifacts if model else [])]
    jobs = select(Job).where(Job.id.in_({each.job_id for each in found}))
    kinds = {job.id: job.kind for job in session.scalars(jobs)}
    known = {NOTE, TEMPLATE_FILE}
    for each in found:
        if each.name not in known:
            known.add(each.name)
            about = ArtifactView.model_validate(each).model_dump()
            yield {**about, "kind": kinds[each.job_id]}


def _template_sha256(model: Job | None) -> str | None:
    """Return the file of the template that a model was made of; None: the built-in anatomy."""
    inputs = model.inputs if model else []
    return next((each["sha256"] for each in inputs if each["role"] == "template"), None)


def _template(session: Session, sha256: str | None) -> Template | None:
    query = select(Template).where(Template.sha256 == sha256).order_by(Template.created_at)
    return session.scalars(query).first()


def _about(template: Template | None, sha256: str | None) -> dict[str, Any] | None:
    """Return what `rig.json` says of a template, also of one that was deleted meanwhile."""
    if template is not None:
        return {"id": template.id, "name": template.name}
    return {"sha256": sha256, "missing": True} if sha256 else None


def _as_artifacts(template: Template | None) -> list[File]:
    if template is None:
        return []
    about = {"id": template.id, "size": template.size, "sha256": template.sha256}
    return [{**about, "name": TEMPLATE_FILE, "media_type": NPZ, "job_id": None, "kind": "template"}]


def _note(
    session: Session, rig: Rig, files: list[File], template: dict[str, Any] | None
) -> dict[str, Any]:
    """Return what `rig.json` says."""
    subject = session.get_one(Subject, rig.subject_id)
    return {
        "id": rig.id,
        "name": rig.name,
        "labels": rig.labels,
        "verdict": verdict_in(rig.summary),
        "subject_id": rig.subject_id,
        "job_id": rig.job_id,
        "model_job_id": rig.model_job_id,
        "parent_id": rig.parent_id,
        "expressions": rig.expressions,
        "summary": rig.summary,
        "created_at": rig.created_at.isoformat(),
        "subject": {"id": subject.id, "name": subject.name, "template_id": subject.template_id},
        "template": template,
        "artifacts": files,
    }


@dataclass(frozen=True)
class RigArchive(Sendable):
    """The ZIP file of a rig."""

    rig_id: str
    made: datetime
    members: Sequence[Member]
    store: Store

    @classmethod
    def of(cls, rig: Rig, members: Sequence[Member], store: Store) -> RigArchive:
        """Return a rig's archive; the first of its ``members`` names the others."""
        size = sum(map(length, lay_out([(each, 0) for each in members], rig.created_at)))
        about = f"rig-{rig.id[:8]}.zip", "application/zip", size, members[0].sha256
        return cls(*about, rig.id, rig.created_at, members, store)

    def check(self) -> None:
        """See `Sendable`: also faults that were found before."""
        names = {each.sha256: each.name for each in self.members}
        with self.store.read() as session:
            suspected = faults(session).keys() & names
        for sha256 in suspected:
            if fault := known_fault(self.store, sha256):
                raise self._lost(names[sha256], LostFileError(sha256, fault))

    def blocks(self, span: ByteRange) -> Iterator[bytes]:
        """See `Sendable`."""
        self.check()
        parts = lay_out([(each, self._checksum(each)) for each in self.members], self.made)
        return self._blocks(parts, span)

    def _checksum(self, member: Member) -> int:
        if member.content is not None:
            return zlib.crc32(member.content)
        try:
            return _checksum_once(self.store.files, member.sha256)
        except LostFileError as error:
            raise self._lost(member.name, error) from error

    def _lost(self, name: str, error: LostFileError) -> Problem:
        """Return the problem of a file that cannot be sent, unless the rig has been deleted."""
        with self.store.read() as session:
            if session.get(Rig, self.rig_id) is None:
                return not_found("rig", self.rig_id)
        note_fault(self.store, error.sha256, error.fault)
        return lost(name, error.fault, rig_id=self.rig_id)

    def _blocks(self, parts: Iterable[bytes | Member], span: ByteRange) -> Iterator[bytes]:
        place = 0
        for part in parts:
            start = max(span.start - place, 0)
            end = min(span.end - place, length(part))
            place += length(part)
            if start >= end:
                continue
            if isinstance(part, bytes):
                yield part[start:end]
            elif part.content is not None:
                yield part.content[start:end]
            else:
                yield from self._read(part, ByteRange(start, end))

    def _read(self, member: Member, span: ByteRange) -> Iterator[bytes]:
        """Read a part of a file; a fault cuts the answer off, and the next request is refused."""
        try:
            if span == ByteRange(0, member.size):
                yield from open_checked(self.store.files, member.sha256)
            else:
                yield from self.store.files.open(member.sha256, *span)
        except LostFileError as error:
            note_fault(self.store, error.sha256, error.fault)
            raise


# Locks of the files that are being read for their checksums
_reading: dict[str, Lock] = {}


def _checksum_once(files: Files, sha256: str) -> int:
    """Return a file's CRC-32; of the threads that want it at the same time one reads the file."""
    lock = _reading.setdefault(sha256, Lock())
    try:
        with lock:
            return _checksum(files, sha256)
    finally:
        _reading.pop(sha256, None)  # from here on the checksum is remembered


@lru_cache(maxsize=MOST_CHECKSUMS)
def _checksum(files: Files, sha256: str) -> int:
    """Return a file's CRC-32, of the bytes that its name says; raises :class:`LostFileError`."""
    found = 0
    for block in open_checked(files, sha256):
        found = zlib.crc32(block, found)
    return found


# The layout, after PKWARE's APPNOTE 6.3: a header before each file, the directory at the end.

STORED = 0
UTF8 = 0x800
PLAIN = 20  # version that a reader needs
WITH_ZIP64 = 45  # version that a reader of ZIP64 needs
UNIX = 3 << 8  # the system whose rights a file has
OWNERS = 0o100600 << 16  # a face's files are nobody's else
# Values from these on stand in the fields of ZIP64
LARGE = 0xFFFFFFFF
MANY = 0xFFFF


def length(part: bytes | Member) -> int:
    """Return the bytes of a part of an archive."""
    return len(part) if isinstance(part, bytes) else part.size


def lay_out(files: Iterable[tuple[Member, int]], made: datetime) -> list[bytes | Member]:
    """Return the parts of an archive of files with their CRC-32, in their order."""
    date = (max(made.year, 1980) - 1980) << 9 | made.month << 5 | made.day
    stamp = made.hour << 11 | made.minute << 5 | made.second // 2, date
    parts: list[bytes | Member] = []
    entries = []
    place = 0
    for member, checksum in files:
        name = member.name.encode()
        size = member.size
        shown = min(size, LARGE)
        at = min(place, LARGE)
        doubled = [size, size] if shown == LARGE else []
        sizes = _zip64(doubled)
        extra = _zip64(doubled + ([place] if at == LARGE else []))
        version = WITH_ZIP64 if extra else PLAIN
        common = version, UTF8, STORED, *stamp, checksum, shown, shown, len(name)
        head = struct.pack("<4s5H3I2H", b"PK\3\4", *common, len(sizes)) + name + sizes
        entry = struct.pack(
            "<4s6H3I5H2I", *(b"PK\1\2", UNIX | version, *common, len(extra), 0, 0, 0, OWNERS, at)
        )
        entries.append(entry + name + extra)
        parts += [head, member]
        place += len(head) + size
    directory = b"".join(entries)
    return [*parts, directory, _end(len(entries), len(directory), place)]


def _zip64(values: Sequence[int]) -> bytes:
    """Return the extra field of values that a header has no room for."""
    return struct.pack(f"<2H{len(values)}Q", 1, 8 * len(values), *values) if values else b""


def _end(count: int, size: int, place: int) -> bytes:
    """Return what ends an archive: where its directory is."""
    shown = min(count, MANY), min(size, LARGE), min(place, LARGE)
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, shown[0], *shown, 0)
    if count < MANY and max(size, place) < LARGE:
        return end
    version = UNIX | WITH_ZIP64, WITH_ZIP64
    large = struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, *version, 0, 0, count, count, size, place)
    return large + struct.pack("<4sIQI", b"PK\6\7", 0, place + size, 1) + end
