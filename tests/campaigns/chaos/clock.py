"""A clock that can be set, for the processes of the service and of its database alone."""

from __future__ import annotations

import os
import struct
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

SOURCE = Path(__file__).with_name("clock.c")


class Clock:
    """The seconds by which all processes started within `settable_clock` are ahead."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self.set(0.0)

    def set(self, ahead: float) -> None:
        """Set it to so many seconds, rounded, before or behind the machine's."""
        with self._file.open("r+b" if self._file.exists() else "w+b") as file:
            file.write(struct.pack("=q", round(ahead)))


@contextmanager
def settable_clock(folder: Path) -> Iterator[Clock | None]:
    """Let processes that are started have a clock that can be set; None: no compiler is here."""
    library = folder / "clock.so"
    file = folder / "ahead"
    compile_it = ["cc", "-shared", "-fPIC", "-O1", "-o", str(library), str(SOURCE)]
    try:
        subprocess.run(compile_it, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        yield None
        return
    clock = Clock(file)
    file.chmod(0o644)  # PostgreSQL is another user's
    library.chmod(0o755)
    with mock.patch.dict(os.environ, LD_PRELOAD=str(library), MYOFACE_CHAOS_CLOCK=str(file)):
        yield clock
