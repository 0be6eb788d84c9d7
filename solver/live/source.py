"""What a live session follows a face by: one protocol for frames of all kinds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from solver.similarity import Similarity
from solver.surface import Floats


@dataclass(frozen=True)
class FollowedFace:
    """A face followed in one frame.

    ``clues`` (d,) tell beside the values how the flesh differs from the reduced skin: what is left
    of the frame's points, in mm, 0 where nothing was seen or what was is wrong.
    """

    values: Floats  # (s,) of the sliders
    head: Similarity  # its motion into the take, in the model's axes
    clues: Floats
    is_held: bool  # the frame said nothing of use


class LiveSource(Protocol):
    """A kind of frames, and how the face is followed by them."""

    rows: int  # of a frame's numbers
    width: int  # 3 for places, 1 for weights
    labels: tuple[str, ...]  # of the rows, none where they have numbers alone
    clue_count: int  # d

    def step(self, numbers: Floats, seconds: float) -> FollowedFace:
        """Follow a frame (rows, width), NaN for what was not seen, so long after the last one."""

    def begin(self) -> None:
        """Forget what was before, as where the clock jumps."""

    def resume(self, values: Floats, head: Similarity) -> None:
        """Go on from a frame that another source of its kind has followed."""
