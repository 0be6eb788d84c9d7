"""Soft-tissue depths: how far bone lies under the skin at landmarks, with their sources."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Depth:
    """The mean depth in mm of ``bone`` (cranium or mandible) under a landmark of the skin.

    ``deviation`` is the standard deviation over persons in mm, None where it is not known.
    """

    landmark: str
    bone: str
    mean: float
    deviation: float | None
    source: str
