"""Uploads that were begun, remembered in the user's cache: a later run goes on with them."""

from __future__ import annotations

import hashlib
import os
import time
from contextlib import suppress
from pathlib import Path

KEPT_S = 7 * 24 * 3600
"""Longer than any service keeps an upload that nobody goes on with."""


def folder() -> Path:
    """Return where the notes are: ``$MYOFACE_CACHE/uploads``, else ``~/.cache/myoface/uploads``."""
    cache = os.environ.get("MYOFACE_CACHE") or Path.home() / ".cache" / "myoface"
    return Path(cache) / "uploads"


class Note:
    """A note of one upload: a file named by the service, the file's name and its bytes."""

    def __init__(self, url: str, filename: str, sha256: str) -> None:
        name = hashlib.sha256(f"{url}\n{filename}\n{sha256}".encode()).hexdigest()
        self._path = folder() / name[:32]

    def read(self) -> str | None:
        """Return the upload's id; None: there is no such note."""
        try:
            return self._path.read_text(encoding="ascii").strip() or None
        except (OSError, UnicodeDecodeError):
            return None

    def write(self, upload_id: str) -> None:
        """Note an upload that has begun; a cache that can not be written is no fault."""
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            _forget_old(self._path.parent)
            self._path.write_text(upload_id, encoding="ascii")

    def remove(self) -> None:
        """Forget an upload that is over."""
        with suppress(OSError):
            self._path.unlink(missing_ok=True)


def _forget_old(notes: Path) -> None:
    limit = time.time() - KEPT_S
    for path in notes.iterdir():
        if path.stat().st_mtime < limit:
            path.unlink(missing_ok=True)
