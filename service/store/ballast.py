"""Ballast: room on the disk of SQLite's file, which is given up so that a deletion can be written.

Deleting writes, too: on a disk without any room nobody could make some.
"""

from __future__ import annotations

import errno
import os
import shutil
from contextlib import suppress
from pathlib import Path

import structlog

from service.background import Background

SIZE = 64 * 1024**2
# A deletion needs so much, with its write-ahead log
NEEDED = 16 * 1024**2
EVERY = 60.0

log = structlog.get_logger()


class Ballast(Background):
    """Keeps a file of ``size`` bytes in ``folder`` while there is room; none without a folder."""

    def __init__(self, folder: Path | None, size: int = SIZE, needed: int = NEEDED) -> None:
        super().__init__("ballast", EVERY)
        self._file = folder and folder / "ballast"
        self._size = size
        self._needed = needed

    def drop(self) -> None:
        """Give up the file if the disk is all but full."""
        if self._file is None or self._free(self._file) >= self._needed:
            return
        with suppress(FileNotFoundError):
            self._file.unlink()
            log.warning("ballast.dropped", file=str(self._file))

    def lay(self) -> None:
        """Take the room, if there is plenty."""
        if not hasattr(os, "posix_fallocate"):  # macOS
            return
        if self._file is None or self._file.exists() or self._free(self._file) < 4 * self._size:
            return
        descriptor = os.open(self._file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, self._size)
        except OSError as error:
            self._file.unlink()
            if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EOPNOTSUPP):
                raise
        finally:
            os.close(descriptor)

    def _round(self) -> None:
        self.lay()

    @staticmethod
    def _free(file: Path) -> int:
        return shutil.disk_usage(file.parent).free
