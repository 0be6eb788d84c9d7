"""Faces in motion under muscle tracks: keys of shapes, and shapes for recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation
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
    turn_about,
)
from solver.animation.blendshapes import DrivenShapes, ShapedPose
from solver.animation.performance import FittedSequence, played_head
from solver.errors import InputError, quote, quote_names
from solver.fitting.interior_point import FeasibleSet
from solver.kinds.scene import PerformanceEntry
from solver.model import SubjectModel
from solver.similarity import Similarity
from solver.surface import Floats
from solver.tracks.basis import MuscleTracks, TrackTargets


@dataclass(frozen=True)
class TrackedShapes(DrivenShapes):
    """The shapes of a model's tracks, as recordings drive them."""

    tracks: MuscleTracks
    targets: TrackTargets

    @classmethod
    def of(cls, model: SubjectModel, tracks: MuscleTracks) -> TrackedShapes:
        """Drive a model's tracks by the names of their shapes."""
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


class ShapeDrives(Drives, Protocol):
    """:class:`Drives` of the shapes of tracks."""

    def controls(self, time: float) -> Floats:
        """Return weights and jaw (K + 5,)."""

    def head(self, time: float) -> Similarity:
        """Return the head's motion into the world."""


class PlayedShapes(ShapeDrives):
    """A fitted ``sequence`` of shapes, played by a scene's ``entry``.

    Its first frame is at time 0; ``frames`` (f,) are the numbers of those that are played, those
    ``bridged`` (b,) are blended over. The gain is that of the weights. Raises :class:`InputError`:
    ``scene.shapes`` for a sequence of muscles and for what an entry asks of these,
    ``sequence.shapes`` for shapes that the tracks lack, ``scene.frames``, ``scene.bridges`` and
    ``sequence.values``.
    """

    def __init__(
        self,
        sequence: FittedSequence,
        entry: PerformanceEntry,
        shapes: TrackedShapes,
        model: SubjectModel,
        interpolation: Interpolation = "smooth",
    ) -> None:
        self.entry = entry
        self._shapes = shapes
        self._neck = neck(model)
        if not sequence.shapes:
            reason = "was fitted by muscles, and the scene's face is driven by tracks"
            raise InputError("scene.shapes", f"the performance {entry.asset!r} {reason}")
        if entry.muscles or entry.curve or entry.mask is not None:
            reason = "muscles, curve and mask are of muscles, and shapes drive the face"
            raise InputError("scene.shapes", f"the performance {entry.asset!r}: {reason}")
        if other := sorted(set(sequence.shapes) - set(shapes.names)):
            reason = f"was fitted with other shapes: the tracks have no {quote(other[0])!r}"
            message = f"the performance {entry.asset!r} {reason}"
            raise InputError("sequence.shapes", message, found=quote_names(other))
        played = sequence.played(entry)
        left = played.left
        self.times: Floats = played.times
        self.bridged = played.bridged
        self.frames = left.frames
        weights, jaw = np.split(left.controls, [len(sequence.shapes)], axis=1)
        order = [shapes.names.index(name) for name in sequence.shapes]
        placed = np.zeros((len(weights), len(shapes.names)))  # later tracks may have more shapes
        placed[:, order] = entry.gain * weights
        self._start, turns, moves = played_head(left.head, self._neck, entry)
        values = np.hstack([placed, jaw, turns, moves])
        name = f"performance {entry.asset}"
        self._track = track(played.moments.tolist(), values, name, interpolation)

    @override
    def controls(self, time: float) -> Floats:
        return self._track(time)[:-6]

    @override
    def head(self, time: float) -> Similarity:
        turn, move = np.split(self._track(time)[-6:], 2)
        turned = (self._start * Rotation.from_rotvec(turn)).as_rotvec()
        return turn_about(self._neck, turned, move)

    @override
    def __call__(self, time: float) -> PosedFrame:
        still = PosedFrame.of(self._shapes.at(self.controls(time)))
        return replace(still, head=self.head(time))


class KeyedTracks(ShapeDrives):
    """:class:`Drives` of tracks by ``keys`` of shapes and jaw, with frames at ``times`` (f,) in s.

    Weights are interpolated, each by itself, and the ``head`` turns about the neck. What the keys
    ask for is added to other drives, ``under`` them, if there are any. Raises
    :class:`InputError`: as :func:`solver.animation.track`, ``tracks.name`` for a shape that there
    is not, and ``scene.shapes`` for what else than shapes and a jaw a key has, in the list of keys
    that the scene calls ``what``.
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
        under: ShapeDrives | None = None,
        what: str = "keys",
    ) -> None:
        self.times = times
        self._shapes = shapes
        self._under = under
        for number, key in enumerate(keys):
            if key.expressions or key.activations or key.fibres:
                reason = "the face is driven by its tracks, and these by shapes alone"
                message = f"{what}[{number}] has expressions, muscles or fibres, but {reason}"
                raise InputError("scene.shapes", message, key=number)
        rows = [shapes.tracks.controls(key.shapes, key.jaw) for key in keys]
        values = np.reshape(rows, (len(keys), shapes.tracks.size))
        self._track = track([key.time for key in keys], values, what, interpolation)
        self._head = head_motion(head, neck(model), interpolation)

    @override
    def controls(self, time: float) -> Floats:
        own = self._track(time)
        return own if self._under is None else self._under.controls(time) + own

    @override
    def head(self, time: float) -> Similarity:
        own = self._head(time)
        return own if self._under is None else self._under.head(time).then(own)

    @override
    def __call__(self, time: float) -> PosedFrame:
        still = PosedFrame.of(self._shapes.at(self.controls(time)))
        return replace(still, head=self.head(time))
