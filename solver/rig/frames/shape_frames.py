"""Frames that weights of shapes were fitted to: films, and performances by muscle tracks."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from solver.kinds import FILES
from solver.rig.frames import FrameRecord, SequenceFrame, read_chunks
from solver.surface import Floats


@dataclass(frozen=True)
class ShapeFrame(SequenceFrame):
    """One frame that K weights were fitted to; activations are what they ask of the muscles.

    Distances are those of the face's points from a scan, or of landmarks in a picture, as far as
    these lie apart at the face's distance.
    """

    weights: Floats  # (K,)
    jaw_on_top: Floats  # (5,) of the jaw that the shapes have themselves, rad and mm
    lengths: Floats  # (m,) mm of the muscles' centre lines; zero where there is none

    @property
    def controls(self) -> Floats:
        """The controls (K + 5,) of a face that shapes drive."""
        return np.concatenate([self.weights, self.jaw_on_top])

    FORMAT: ClassVar[int] = FILES["sequence.npz"].formats[2]
    ARRAYS: ClassVar[tuple[str, ...]] = (*FrameRecord.ARRAYS, *("weights", "jaw_on_top", "lengths"))


def read_shape_frames(
    folder: Path,
    shapes: int,
    muscles: int,
    take: Callable[[Mapping[str, Any], Sequence[ShapeFrame]], None] = lambda _values, _frames: None,
) -> list[ShapeFrame]:
    """Return the frames of so many shapes and muscles; raises and ``take`` as `read_chunks`."""
    return read_chunks(
        folder,
        ShapeFrame,
        "sequence.frames",
        lambda frame: (len(frame.weights), len(frame.activations)) == (shapes, muscles),
        take,
    )
