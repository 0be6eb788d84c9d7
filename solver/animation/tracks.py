"""Faces in motion under muscle tracks: keys of shapes, and shapes for recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from typing_extensions import override

from solver.animation import (
    Drives,
    HeadKey,
    Interpolation,
    PosedFrame,
    PoseKey,
    head_motion,
    neck,
    track,
)
from solver.animation.blendshapes import DrivenShapes, ShapedPose
from solver.errors import InputError
from solver.fitting.interior_point import FeasibleSet
from solver.model import SubjectModel
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks, TrackTargets


@dataclass(frozen=True)
class TrackedShapes(DrivenShapes):
    """The shapes of a model's tracks, as recordings drive them."""

    tracks: MuscleTracks
    targets: TrackTargets

    @classmethod
    def of(cls, model: SubjectModel, tracks: MuscleTracks) -> TrackedShapes:
        """Return those of a model's tracks."""
        return cls(tracks, TrackTargets(model, tracks))

    @property
    @override
    def names(self) -> tuple[str, ...]:
        """Return the shapes' names."""
        return self.tracks.names

    @override
    def pose_of(self, weights: Floats, limits: FeasibleSet | None = None) -> ShapedPose:
        """Return the pose of ``weights`` (K,); tracks know no ``limits`` of single muscles."""
        return self.at(np.concatenate([weights, np.zeros(self.tracks.size - len(weights))]))

    def at(self, q: Floats) -> ShapedPose:
        """Return the pose of weights and jaw q (K + 5,)."""
        pose = self.targets.at(q)
        return ShapedPose(pose.activations, pose.jaw, 0, pose.target)


class KeyedTracks(Drives):
    """:class:`Drives` of tracks by ``keys`` of shapes and jaw, with frames at ``times`` (f,) in s.

    Weights are interpolated, each by itself, and the ``head`` turns about the neck. Raises
    :class:`InputError`: as :func:`solver.animation.track`, ``tracks.name`` for a shape that there
    is not, and ``scene.shapes`` for what else than shapes and a jaw a key has.
    """

    def __init__(
        self,
        keys: Sequence[PoseKey],
        shapes: TrackedShapes,
        model: SubjectModel,
        times: Floats,
        *,
        head: Sequence[HeadKey] = (),
        interpolation: Interpolation = "smooth",
    ) -> None:
        self.times, self._shapes = times, shapes
        for number, key in enumerate(keys):
            if key.expressions or key.activations or key.fibres:
                reason = "the face is driven by its tracks, and these by shapes alone"
                message = f"keys[{number}] has expressions, muscles or fibres, but {reason}"
                raise InputError("scene.shapes", message, key=number)
        rows = [shapes.tracks.controls(key.shapes, key.jaw) for key in keys]
        values = np.reshape(rows, (len(keys), shapes.tracks.size))
        self._track = track([key.time for key in keys], values, "keys", interpolation)
        self._head = head_motion(head, neck(model), interpolation)

    @override
    def __call__(self, time: float) -> PosedFrame:
        still = PosedFrame.of(self._shapes.at(self._track(time)))
        return replace(still, head=self._head(time))
