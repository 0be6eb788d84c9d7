"""``sequence.glb``: a fitted sequence as an animated skin, for viewers and animation tools.

The skins of all frames are spanned by few shapes, found as the frames come: a frame that the shapes
so far do not reach adds what is left of it. So a frame is a few weights, and nothing waits for the
end of the sequence.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pygltflib as gl

from solver.rig.gltf import Buffer, animation, rigid_tracks, write_face
from solver.rig.sequence import SequenceFrame
from solver.surface import Floats, Surface

REACHED_MM = 0.2
"""How far a vertex may be off its place in the animation, unless there are too many shapes."""
MOST_SHAPES = 48


class AnimatedSkin:
    """Takes the skins (v, 3), mm, of a sequence's frames."""

    def __init__(self, neutral: Surface) -> None:
        self._neutral = neutral
        self._shapes = np.zeros((0, neutral.vertices.size), np.float32)
        self._weights: list[Floats] = []
        self._frames: list[SequenceFrame] = []

    def add(self, frame: SequenceFrame, skin: Floats) -> None:
        """Take a frame, fitted or not."""
        motion = (skin - self._neutral.vertices).astype(np.float32).ravel()
        weights = self._shapes @ motion
        rest = motion - weights @ self._shapes
        off = np.linalg.norm(rest.reshape(-1, 3), axis=1).max()
        if len(weights) < MOST_SHAPES and off > REACHED_MM:
            length = np.linalg.norm(rest)
            self._shapes = np.vstack([self._shapes, rest / length])
            weights = np.append(weights, length)
        self._weights.append(weights.astype(np.float64))
        self._frames.append(frame)

    def write(self, path: Path, fps: float) -> None:
        """Write the animation, in metres; a node carries the motion of the head.

        A shape that is needed both ways is two morph targets: animation tools hold weights between
        0 and 1.
        Without a frame, or if neither face nor head moves, it is the neutral.
        """
        weights = np.zeros((len(self._weights), len(self._shapes)))
        for row, values in zip(weights, self._weights, strict=True):
            row[: len(values)] = values
        shapes, tracks = {}, [np.zeros((len(weights), 0))]
        for number, (track, shape) in enumerate(zip(weights.T, self._shapes, strict=True)):
            for name, way in ((f"shape_{number}", 1.0), (f"shape_{number}_back", -1.0)):
                one_way = np.maximum(way * track, 0.0)
                if (most := one_way.max()) > 0.0:
                    shapes[name] = self._neutral.vertices + (way * most * shape).reshape(-1, 3)
                    tracks.append(one_way[:, None] / most)

        def animate(buffer: Buffer, _count: int) -> gl.Animation | None:
            return _animation(buffer, self._frames, np.hstack(tracks), fps)

        write_face(path, self._neutral, shapes, animate)


def _animation(
    buffer: Buffer, frames: Sequence[SequenceFrame], weights: Floats, fps: float
) -> gl.Animation | None:
    heads = np.array([frame.head for frame in frames]).reshape(-1, 6)
    times = np.array([frame.frame / fps for frame in frames])
    tracks = {}
    if weights.size:
        at_frames = buffer.dense(times, gl.SCALAR, bounds=True)
        tracks[gl.WEIGHTS] = at_frames, buffer.dense(weights.ravel(), gl.SCALAR)
    if heads.any():
        tracks |= rigid_tracks(buffer, times, heads)
    return animation("sequence", tracks) if tracks else None
