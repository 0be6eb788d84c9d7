"""Content-addressed files: the name is the sha256, so a file never changes and is stored once."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import tempfile
import time
from collections.abc import Container
from dataclasses import dataclass
from pathlib import Path

CHUNK = 1 << 20
SHA256 = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class Blob:
    """A stored file: size in bytes and sha256 in hex."""

    sha256: str
    size: int


class FileStore:
    """A folder of files ``ab/abcdef...`` named by their sha256."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.incoming = root / "incoming"
        self.incoming.mkdir(parents=True, exist_ok=True)

    def path(self, sha256: str) -> Path:
        """Return where the file with this sha256 is."""
        return self.root / sha256[:2] / sha256

    def exists(self, sha256: str) -> bool:
        """Whether there is a file with this sha256."""
        return self.path(sha256).exists()

    def put(self, source: Path) -> Blob:
        """Store a copy of ``source``; it is there as a whole or not at all."""
        descriptor, name = tempfile.mkstemp(dir=self.incoming)
        copy = Path(name)
        try:
            with source.open("rb") as original, os.fdopen(descriptor, "r+b") as file:
                shutil.copyfileobj(original, file, CHUNK)
                file.flush()
                os.fsync(file.fileno())
                size = file.tell()
                file.seek(0)
                sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            target = self.path(sha256)
            target.parent.mkdir(exist_ok=True)
            copy.chmod(0o444)
            # Also if it is there already: the new date keeps it from the garbage collection.
            copy.replace(target)
        finally:
            copy.unlink(missing_ok=True)
        return Blob(sha256, size)

    def fetch(self, sha256: str, target: Path) -> None:
        """Copy a stored file to ``target``."""
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(self.path(sha256), target)

    def collect_garbage(self, referenced: Container[str], age: float) -> int:
        """Remove files that nothing refers to and that are older than ``age`` seconds.

        The age protects what is stored but whose row is not committed yet. Returns how many went.
        """
        limit = time.time() - age
        stored = (path for path in self.root.glob("??/*") if SHA256.fullmatch(path.name))
        removed = 0
        for path in [*stored, *self.incoming.iterdir()]:
            if path.name in referenced or not _is_older(path, limit):
                continue
            path.unlink(missing_ok=True)
            removed += 1
        return removed


def _is_older(path: Path, limit: float) -> bool:
    try:
        return path.stat().st_mtime < limit
    except FileNotFoundError:  # an incoming file that has just become a stored one
        return False
