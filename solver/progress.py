"""Progress of a long computation, reported without knowing who listens."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol


@dataclass(frozen=True)
class Step:
    """One report of progress; the numbers are given where they have a meaning."""

    phase: str  # a short stable key (``mesh``, ``muscles``, ``geometry`` ...)
    fraction: float  # of the whole job, in [0, 1]
    iteration: int | None = None
    residual: float | None = None
    mean_error_mm: float | None = None
    message: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the step as JSON values, without the fields that were not given."""
        return {key: value for key, value in asdict(self).items() if value is not None}


class ProgressCallback(Protocol):
    """Anything that takes a :class:`Step`."""

    def __call__(self, step: Step, /) -> None:
        """Take one report of progress."""


def silent(_step: Step, /) -> None:
    """Listen to nothing."""


def part_of(progress: ProgressCallback, start: float, end: float = 1.0) -> ProgressCallback:
    """Return a callback for a part of the whole: its way from 0 to 1 is [start, end] there."""
    return lambda step, /: progress(replace(step, fraction=start + step.fraction * (end - start)))
