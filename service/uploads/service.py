"""Receiving bytes: the offset in the table counts, under a lock per upload.

Bytes are written and flushed before the offset moves, so a service that dies in between has lost
at most the last `COUNT_EVERY` bytes, and a later request overwrites what was not counted.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import BinaryIO

import structlog
from anyio import to_thread
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session
from starlette.requests import ClientDisconnect

from service.access.limits import check_bytes
from service.background import Background
from service.errors import CHECKSUM_MISMATCH, Problem
from service.settings import Settings
from service.store.database import Store, clock
from service.store.files import Blob
from service.store.models import Upload, now
from service.uploads import repository
from service.uploads.pictures import without_metadata
from service.uploads.schemas import Checksum
from service.writers import Places

BUFFER = 1 << 20
# Bytes of a request after which those that have arrived are counted
COUNT_EVERY = 16 << 20

# The name of an unfinished upload's file: its id
PART = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
EVERY = 60.0

log = structlog.get_logger()


@dataclass(frozen=True)
class _Stored:
    """What is stored of an upload, and the digest of what was sent."""

    blob: Blob
    sent_sha256: str


class UploadService:
    """Uploads of one store; unfinished ones are files ``<id>`` in ``settings.uploads``."""

    def __init__(self, store: Store, settings: Settings) -> None:
        self._store = store
        self._settings = settings
        settings.uploads.mkdir(parents=True, exist_ok=True)

    def create(self, filename: str, size: int, sha256: str | None) -> Upload:
        """Start an upload of ``size`` bytes."""
        if size == 0:
            raise Problem(422, "upload.empty", f"{filename} is empty", file=filename)
        if size > self._settings.max_upload_bytes:
            raise Problem(
                413,
                "upload.too_large",
                f"{filename} is larger than the limit",
                file=filename,
                expected=self._settings.max_upload_bytes,
                found=size,
            )
        with self._store.write() as session:
            self._refuse_too_many(session)
            check_bytes(session, size)
            until = clock(session) + timedelta(seconds=self._settings.upload_ttl)
            upload = Upload(filename=filename, size=size, sha256=sha256, expires_at=until)
            session.add(upload)
            session.flush()
            self._part(upload.id).touch()
        return upload

    def _refuse_too_many(self, session: Session) -> None:
        most = self._settings.max_open_uploads
        if repository.count_open(session) >= most:
            problem = Problem(
                429,
                "upload.too_many",
                f"there are {most} unfinished uploads; finish or delete some first",
                expected=most,
            )
            problem.headers = {"Retry-After": "60"}
            raise problem

    def get(self, upload_id: str) -> Upload:
        """Return an upload."""
        with self._store.read() as session:
            return repository.get(session, upload_id)

    def settle(self, upload_id: str) -> Upload:
        """Return an upload as it is when nobody is writing.

        One whose last byte arrived just before the service died is completed here.
        """
        upload = self.get(upload_id)
        if upload.complete:
            return upload
        try:
            with self._lock_part(upload_id):
                pass  # no longer than it takes to see that it is free: a writer would be refused
            upload = self.get(upload_id)
            if _is_settled(upload):
                return upload
            with self._lock_part(upload_id):
                upload = self.get(upload_id)
                return upload if _is_settled(upload) else self._finish(upload, self._put(upload))
        except Problem as problem:
            if problem.code != "upload.closed":
                raise
            upload = self.get(upload_id)
            if not upload.complete:
                raise
            return upload  # its last bytes came between a look into the table and its lock

    def delete(self, upload_id: str) -> None:
        """Give an upload up; what was made from it stays. 423 while another request writes."""
        if self.get(upload_id).complete:
            self._forget(upload_id)
            return
        with self._lock_part(upload_id):
            self._forget(upload_id)
            self._part(upload_id).unlink(missing_ok=True)

    def _forget(self, upload_id: str) -> None:
        with self._store.write() as session:
            session.delete(repository.get(session, upload_id))

    async def receive(
        self,
        upload_id: str,
        offset: int,
        checksum: Checksum | None,
        body: AsyncIterator[bytes],
        writers: Places,
    ) -> Upload:
        """Append ``body`` at ``offset``; what arrives before a client breaks off counts.

        A place among ``writers`` is taken whenever bytes are counted.

        Raises
        ------
        Problem
            409 for a wrong offset, 423 while another request writes, 413 for too many bytes,
            460 for a wrong checksum: nothing of this request is kept then, and nothing at all if
            it is the whole file's.
        """
        upload = await to_thread.run_sync(self.get, upload_id)
        _check_offset(upload, offset)
        with self._lock_part(upload_id) as part:
            upload = await to_thread.run_sync(self.get, upload_id)
            _check_offset(upload, offset)
            if (found := part.seek(0, os.SEEK_END)) < offset:
                # a power cut took bytes that were counted
                _check_offset(await self._count_in_turn(upload, found, writers), offset)
            digest = hashlib.new(checksum.algorithm) if checksum else None
            part.seek(offset)
            part.truncate()

            async def count(received: int) -> None:
                try:
                    await self._count_in_turn(upload, offset + received, writers)
                except (SQLAlchemyError, Problem) as error:  # the end of the request counts them
                    log.warning("uploads.not_counted", error=str(error))

            # of what a checksum is to prove, nothing counts before
            counting = None if digest else count
            received = await _write(part, body, digest, upload.size - offset, counting)
            if received is None:
                await self._count_in_turn(upload, offset, writers)
                raise Problem(
                    413,
                    "upload.overflow",
                    f"{upload.filename}: more bytes than its {upload.size}",
                    file=upload.filename,
                    expected=upload.size - offset,
                )
            if checksum and digest and digest.digest() != checksum.digest:
                raise Problem(
                    CHECKSUM_MISMATCH,
                    "upload.checksum",
                    f"{upload.filename}: these bytes do not have the given checksum",
                    file=upload.filename,
                    expected=checksum.digest.hex(),
                    found=digest.hexdigest(),
                )
            return await self._count_in_turn(upload, offset + received, writers)

    async def _count_in_turn(self, upload: Upload, offset: int, writers: Places) -> Upload:
        async with writers.place() as until:
            upload = await to_thread.run_sync(self._within(until)._count, upload, offset)
        if offset < upload.size:
            return upload
        stored = await to_thread.run_sync(self._put, upload)  # takes long: nobody waits for it
        async with writers.place() as until:
            return await to_thread.run_sync(self._within(until)._finish, upload, stored)

    def _within(self, until: float) -> UploadService:
        """Return this service, whose writes begin by a moment of `time.monotonic` or not at all."""
        return UploadService(self._store.by(until), self._settings)

    def _count(self, upload: Upload, offset: int) -> Upload:
        with self._store.write() as session:
            upload = repository.get(session, upload.id)
            upload.offset = offset
        return upload

    def _put(self, upload: Upload) -> _Stored | int:
        """Store an upload's bytes; where some are missing, return how many there are.

        Of photographs those bytes that tell more than the picture are zero.
        """
        part = self._part(upload.id)
        with suppress(FileNotFoundError):
            if (found := part.stat().st_size) < upload.size:
                return found
        try:
            with without_metadata(part, upload.filename) as file:
                blob = self._store.files.put(file)
                sent = blob.sha256 if file == part else _digest_of(part)
                return _Stored(blob, sent)
        except FileNotFoundError as error:
            # its row is gone too: the `UploadCleaner` removes no file that has one
            raise Problem(
                410, "upload.expired", "the upload has expired", upload_id=upload.id
            ) from error

    def _finish(self, upload: Upload, stored: _Stored | int) -> Upload:
        """Note what :meth:`_put` has found."""
        if isinstance(stored, int):
            return self._count(upload, stored)
        part = self._part(upload.id)
        with self._store.write() as session:
            upload = repository.get(session, upload.id)
            if upload.sha256 in (None, stored.sent_sha256):
                upload.sha256 = stored.blob.sha256
                upload.sent_sha256 = stored.sent_sha256
                upload.complete = True
            else:
                session.delete(upload)
        part.unlink(missing_ok=True)
        if not upload.complete:
            raise Problem(
                CHECKSUM_MISMATCH,
                "upload.checksum",
                f"{upload.filename} does not have the sha256 it was announced with",
                file=upload.filename,
                expected=upload.sha256,
                found=stored.sent_sha256,
            )
        return upload

    def _part(self, upload_id: str) -> Path:
        return self._settings.uploads / upload_id

    @contextmanager
    def _lock_part(self, upload_id: str) -> Iterator[BinaryIO]:
        try:
            part = self._part(upload_id).open("r+b")
        except FileNotFoundError as error:
            raise Problem(
                409, "upload.closed", "the upload was completed or deleted", upload_id=upload_id
            ) from error
        with part:
            try:
                fcntl.flock(part, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise Problem(
                    423, "upload.locked", "another request is writing", upload_id=upload_id
                ) from error
            yield part


def _digest_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _is_settled(upload: Upload) -> bool:
    """Return whether nothing is left to do but for a client that sends more."""
    return upload.complete or upload.offset < upload.size


def _check_offset(upload: Upload, offset: int) -> None:
    if upload.complete or upload.offset != offset:
        raise Problem(
            409,
            "upload.offset",
            f"{upload.filename}: the next byte is {upload.offset}, not {offset}",
            file=upload.filename,
            expected=upload.offset,
            found=offset,
        )


async def _write(
    part: BinaryIO,
    body: AsyncIterator[bytes],
    digest: hashlib._Hash | None,
    room: int,
    count: Callable[[int], Awaitable[None]] | None,
) -> int | None:
    """Write ``body``; returns the number of bytes, None if they are more than ``room``.

    ``count`` is told now and then how many are safe on the disk, never that they are all.
    """
    received = counted = 0
    buffer = bytearray()

    def flush() -> None:
        if digest:
            digest.update(buffer)
        part.write(buffer)
        buffer.clear()

    def secure() -> None:
        part.flush()
        os.fsync(part.fileno())

    try:
        async for chunk in body:
            received += len(chunk)
            if received > room:
                return None
            buffer += chunk
            if len(buffer) >= BUFFER:
                await to_thread.run_sync(flush)
                if count and counted + COUNT_EVERY <= received < room:
                    await to_thread.run_sync(secure)
                    await count(received)
                    counted = received
    except ClientDisconnect:
        pass  # what has arrived counts, unless a checksum says that it is not whole
    await to_thread.run_sync(flush)
    await to_thread.run_sync(secure)
    return received


class UploadCleaner(Background):
    """Removes the bytes of uploads that expired, or that a service which died left.

    Each API process tidies its own folder, which no worker may reach.
    """

    def __init__(self, store: Store, settings: Settings) -> None:
        super().__init__("uploads", min(EVERY, settings.garbage_age))
        self._store = store
        self._folder = settings.uploads
        self._age = timedelta(seconds=settings.garbage_age)

    def _round(self) -> None:
        # Listed before the table is read: the row of what is that old has long been committed.
        parts = _older(self._folder, (now() - self._age).timestamp())
        if not parts:
            return
        with self._store.read() as session:
            wanted = repository.unfinished_ids(session)
        abandoned = [part for part in parts if part.name not in wanted]
        for part in abandoned:
            part.unlink(missing_ok=True)
        if abandoned:
            log.info("uploads.tidied", count=len(abandoned))


def _older(folder: Path, limit: float) -> list[Path]:
    """Return the unfinished uploads' files that nothing was written to since ``limit``."""
    found = []
    for path in folder.glob("*-*"):
        try:
            if PART.fullmatch(path.name) and path.stat().st_mtime < limit:
                found.append(path)
        except FileNotFoundError:  # completed or deleted meanwhile
            continue
    return found
