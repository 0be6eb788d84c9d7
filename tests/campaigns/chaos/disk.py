"""Disks small enough to be filled."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MEGABYTES = 16


class Disk:
    """A folder that can be filled to the last byte."""

    def __init__(self, folder: Path) -> None:
        self._stuffing = folder / "stuffing"

    def fill(self) -> None:
        """Leave no room."""
        with self._stuffing.open("ab", buffering=0) as file:
            size = 1 << 20
            while size:
                try:
                    file.write(bytes(size))
                except OSError:
                    size //= 2

    def clear(self) -> None:
        """Make room again."""
        self._stuffing.unlink(missing_ok=True)


@contextmanager
def small_disk(folder: Path, megabytes: int = MEGABYTES) -> Iterator[Disk | None]:
    """Mount a small disk at ``folder``; None: this machine does not allow it."""
    folder.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "myoface-chaos", str(folder)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        yield None
        return
    try:
        yield Disk(folder)
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)
