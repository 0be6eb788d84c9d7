"""Files in a folder, which several hosts may share."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from service.store.durable import sync_folder
from service.store.files.base import CHUNK, Blob, Files, StoredFile, copy_plain

SHA256 = re.compile(r"[0-9a-f]{64}")


class FolderFiles(Files):
    """A folder of files ``ab/abcdef...`` named by their sha256."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.incoming = root / "incoming"
        self._aside = root / "aside"
        for folder in (self.incoming, self._aside):
            folder.mkdir(parents=True, exist_ok=True)

    def path(self, sha256: str) -> Path:
        """Return where the file with this sha256 is."""
        return self.root / sha256[:2] / sha256

    def put(self, source: Path, most: int | None = None) -> Blob:
        """Store a copy of ``source`` of at most ``most`` bytes; it is there whole or not at all."""
        descriptor, name = tempfile.mkstemp(dir=self.incoming)
        copy = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as file:
                blob = copy_plain(source, file, most)
                os.fsync(file.fileno())
            target = self.path(blob.sha256)
            copy.chmod(0o400)
            if not target.parent.is_dir():
                target.parent.mkdir(exist_ok=True)
                sync_folder(self.root)
            # Also if it is there already: the new date keeps it from the garbage collection.
            copy.replace(target)
            sync_folder(target.parent)
        finally:
            copy.unlink(missing_ok=True)
        return blob

    def open(self, sha256: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        """Give the bytes from ``start`` to before ``end``; a missing file is known at once."""
        file = self._open(sha256)
        file.seek(start)
        return _blocks(file, None if end is None else end - start)

    def size(self, sha256: str) -> int:
        """Return the size in bytes."""
        with self._open(sha256) as file:
            return os.fstat(file.fileno()).st_size

    def list_stored(self) -> Iterator[StoredFile]:
        """List what is stored and not put aside."""
        return _list(self.root.glob("??/*"))

    def put_aside(self, sha256: str) -> None:
        """Take a file out of the list; it can still be read."""
        path = self._aside / sha256
        stored = self.path(sha256)
        stored.rename(path)
        os.utime(path)
        sync_folder(self._aside)
        sync_folder(stored.parent)

    def list_aside(self) -> Iterator[StoredFile]:
        """List what was put aside, and when."""
        return _list(self._aside.iterdir())

    def take_back(self, sha256: str) -> None:
        """Put a file that was put aside where it was."""
        path = self._aside / sha256
        with suppress(FileExistsError):  # stored again meanwhile
            os.link(path, self.path(sha256))
        sync_folder(self.path(sha256).parent)
        path.unlink()

    def remove(self, sha256: str) -> None:
        """Remove a file that was put aside, for good."""
        (self._aside / sha256).unlink()
        sync_folder(self._aside)

    def remove_unfinished(self, before: datetime) -> None:
        """Remove what interrupted `put` calls left before a moment."""
        for path in self.incoming.iterdir():
            with suppress(FileNotFoundError):  # it has just become a stored one
                if path.stat().st_mtime < before.timestamp():
                    path.unlink()

    def ready(self) -> bool:
        """Return whether files can be stored."""
        return os.access(self.incoming, os.W_OK)

    def _open(self, sha256: str) -> BinaryIO:
        try:
            return self.path(sha256).open("rb")
        except FileNotFoundError:
            with suppress(FileNotFoundError):
                return (self._aside / sha256).open("rb")
            return self.path(sha256).open("rb")  # taken back between the two looks, or missing


def _blocks(file: BinaryIO, length: int | None) -> Iterator[bytes]:
    with file:
        while length is None or length > 0:
            block = file.read(CHUNK if length is None else min(CHUNK, length))
            if not block:
                return
            if length is not None:
                length -= len(block)
            yield block


def _list(paths: Iterator[Path]) -> Iterator[StoredFile]:
    for path in paths:
        if SHA256.fullmatch(path.name):
            with suppress(FileNotFoundError):
                yield StoredFile(path.name, datetime.fromtimestamp(path.stat().st_mtime, UTC))
