"""Interface of a content-addressed file store, wherever it keeps its files."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import IO

CHUNK = 1 << 18


@dataclass(frozen=True)
class Blob:
    """A stored file: size in bytes and sha256 in hex."""

    sha256: str
    size: int


@dataclass(frozen=True)
class StoredFile:
    """A stored file as it is listed: ``at`` is when it was stored the last time."""

    sha256: str
    at: datetime


class DamagedFileError(OSError):
    """A stored file is not what its name says."""

    def __init__(self, sha256: str) -> None:
        super().__init__(errno.EIO, "a stored file is damaged", sha256)


class LargerFileError(OSError):
    """A file has more bytes than whoever stores it has room for."""

    def __init__(self, source: Path, most: int) -> None:
        super().__init__(errno.EFBIG, f"a file has more than {most} bytes", source.name)


class UnreachableError(OSError):
    """The store does not answer."""

    def __init__(self, reason: str) -> None:
        super().__init__(errno.EHOSTUNREACH, f"the file store does not answer: {reason}")


class Files(ABC):
    """Files named by their sha256.

    A file that nothing refers to is first put aside, where it can still be read, and removed a
    while later unless something refers to it then: between a look into the tables and a removal,
    somebody may store the same bytes again.

    Every method raises :class:`OSError` if the store fails, and those that name a file
    :class:`FileNotFoundError` if it is not there.
    """

    @abstractmethod
    def put(self, source: Path, most: int | None = None) -> Blob:
        """Store a copy of ``source``; it is there as a whole or not at all.

        Raises
        ------
        LargerFileError
            If it has more than ``most`` bytes, at the latest when as many are read: others may be
            writing it.
        """

    @abstractmethod
    def open(self, sha256: str, start: int = 0, end: int | None = None) -> Iterator[bytes]:
        """Give the bytes from ``start`` to before ``end``; a missing file is known at once."""

    @abstractmethod
    def size(self, sha256: str) -> int:
        """Return the size in bytes."""

    @abstractmethod
    def list_stored(self) -> Iterator[StoredFile]:
        """List what is stored and not put aside."""

    @abstractmethod
    def put_aside(self, sha256: str) -> None:
        """Take a file out of the list; it can still be read."""

    @abstractmethod
    def list_aside(self) -> Iterator[StoredFile]:
        """List what was put aside, and when."""

    @abstractmethod
    def take_back(self, sha256: str) -> None:
        """Put a file that was put aside where it was."""

    @abstractmethod
    def remove(self, sha256: str) -> None:
        """Remove a file that was put aside, for good."""

    @abstractmethod
    def remove_unfinished(self, before: datetime) -> None:
        """Remove what interrupted `put` calls left before a moment."""

    @abstractmethod
    def ready(self) -> bool:
        """Return whether files can be stored."""

    def exists(self, sha256: str) -> bool:
        """Return whether there is such a file."""
        try:
            self.size(sha256)
        except FileNotFoundError:
            return False
        return True

    def read(self, sha256: str) -> bytes:
        """Return a whole file, which should be a small one."""
        return b"".join(self.open(sha256))

    def fetch(self, sha256: str, target: Path) -> None:
        """Copy a file to ``target``, checked against its sha256.

        Raises
        ------
        DamagedFileError
            If its bytes are others; ``target`` is not there then.
        """
        target.parent.mkdir(parents=True, exist_ok=True)
        digest = hashlib.sha256()
        with target.open("wb") as file:
            for block in self.open(sha256):
                digest.update(block)
                file.write(block)
        if digest.hexdigest() != sha256:
            target.unlink()
            raise DamagedFileError(sha256)


def copy_plain(source: Path, target: IO[bytes], most: int | None = None) -> Blob:
    """Copy a file that others may change, and name it by the bytes that were copied.

    Neither what a link leads to is copied nor what comes out of a pipe; raises as `Files.put` does.
    """
    digest = hashlib.sha256()
    size = 0
    with os.fdopen(os.open(source, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "no plain file", source.name)
        while block := file.read(CHUNK):
            size += len(block)
            if most is not None and size > most:
                raise LargerFileError(source, most)
            digest.update(block)
            target.write(block)
    target.flush()
    return Blob(digest.hexdigest(), size)
