"""Jobs that are killed on their way, to go on later."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from solver.progress import ProgressCallback, Step


class KilledError(Exception):
    """The end of a job, wherever it is."""


@contextmanager
def killed_after(frame: int, frames: int) -> Iterator[ProgressCallback]:
    """Yield what kills a job that it listens to, once it has fitted the ``frame``; it has to."""

    def stop(step: Step, /) -> None:
        if step.phase == "frames" and step.message == f"frame {frame} of {frames}":
            raise KilledError

    with pytest.raises(KilledError):
        yield stop
