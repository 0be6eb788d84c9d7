"""A recording of Live Link Face, played by a subject's muscles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from solver.animation.blendshapes import Blendshapes, unfold
from solver.animation.keys import HeadKey, HeadMotion, PosedFrame, neck, track, turn_about
from solver.errors import InputError
from solver.model import SubjectModel
from solver.scans.live_link import ARKIT_NAMES, LiveLinkTake
from solver.surface import Floats
from solver.templates.ict_facekit import arkit_source


class RecordedDrives:
    """A :class:`~solver.animation.keys.Drives` of a recording; see :func:`from_recording`.

    ``weights`` (f, e) are what drives each blendshape in the frames.
    """

    def __init__(
        self,
        take: LiveLinkTake,
        shapes: Blendshapes,
        model: SubjectModel,
        frames: slice,
        head: HeadMotion,
    ) -> None:
        self._blend = shapes.blend
        columns = [ARKIT_NAMES.index(arkit_source(name)) for name in self._blend.names]
        self.times: Floats = take.times[frames] - take.times[frames.start]
        self.weights: Floats = np.clip(take.weights[frames][:, columns], 0.0, 1.0)
        turns = np.hstack([take.head[frames], take.eyes[frames].reshape(-1, 6)])
        values = np.hstack([self.weights, turns])
        self._track = track(self.times, values, "frames", "linear")
        self._neck = neck(model)
        self._head = head

    def __call__(self, time: float) -> PosedFrame:
        """See :class:`~solver.animation.keys.Drives`."""
        weights, head, eyes = np.split(self._track(time), [-9, -6])
        pose = self._blend.pose(weights)
        a, clamped = unfold(pose.a)
        motion = turn_about(self._neck, head, np.zeros(3)).then(self._head(time))
        return PosedFrame(a, pose.b, motion, eyes.reshape(2, 3), clamped)


def from_recording(
    take: LiveLinkTake,
    shapes: Blendshapes,
    model: SubjectModel,
    start: int = 0,
    end: int | None = None,
    *,
    head: Sequence[HeadKey] = (),
) -> RecordedDrives:
    """Return the recording's frames from ``start`` to ``end`` (not included; None: the last).

    Times begin at 0. Weights and turns between frames lie on straight lines. The recorded head
    turns about the neck; keys of the ``head`` come on top of that. Raises :class:`InputError`
    (``scene.frames``) if the recording does not have those frames.
    """
    count = len(take.times)
    last = count if end is None else end
    if not 0 <= start < last <= count:
        raise InputError(
            "scene.frames",
            f"the recording has the frames 0 to {count - 1}: start {start} and end {last} are not "
            "within it",
            expected=count,
            start=start,
            end=last,
        )
    motion = HeadMotion(head, neck(model))
    return RecordedDrives(take, shapes, model, slice(start, last), motion)
