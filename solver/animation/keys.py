"""Keyframes: expressions, single muscles and the jaw at chosen times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from solver.animation.blend import Blend, unfolded
from solver.animation.frame import PosedFrame
from solver.animation.head import HeadKey, HeadMotion, neck
from solver.animation.tracks import Interpolation, Track, track
from solver.errors import InputError
from solver.fitting.face import Pose
from solver.mechanics.flesh import IDENTITY
from solver.model import SubjectModel
from solver.surface import Floats


@dataclass(frozen=True)
class Key:
    """What the face does at ``time`` in s; what a key does not name is at rest there.

    ``expressions`` are weights from 0 to 1; ``activations`` are those of single muscles (6,), of
    which what differs from rest is added to the expressions'; so is ``jaw`` (5,), rad and mm.
    """

    time: float
    expressions: Mapping[str, float] = field(default_factory=dict)
    activations: Mapping[str, Floats] = field(default_factory=dict)
    jaw: Floats = field(default_factory=lambda: np.zeros(5))


class KeyedDrives:
    """A :class:`~solver.animation.frame.Drives` between keys; see :func:`from_keys`."""

    def __init__(
        self,
        keys: Sequence[Key],
        poses: Mapping[str, Pose],
        model: SubjectModel,
        times: Floats,
        head: HeadMotion,
        interpolation: Interpolation,
    ) -> None:
        self.times = times
        self._head = head
        _check_names(keys, poses, model)
        used = _named(key.expressions for key in keys)
        self._blend = Blend.of({name: poses[name] for name in used}, model.muscle_count)
        moved = _named(key.activations for key in keys)
        self._muscles = [model.muscle_names.index(name) for name in moved]
        moments = [key.time for key in keys]

        def tracked(values: list[Floats], width: int) -> Track:
            return track(moments, np.reshape(values, (len(keys), width)), "keys", interpolation)

        self._weights = tracked(
            [np.array([key.expressions.get(name, 0.0) for name in used]) for key in keys], len(used)
        )
        self._moves = tracked(
            [
                np.array([key.activations.get(name, IDENTITY) - IDENTITY for name in moved])
                for key in keys
            ],
            6 * len(moved),
        )
        self._jaw = tracked([key.jaw for key in keys], 5)

    def __call__(self, time: float) -> PosedFrame:
        """See :class:`~solver.animation.frame.Drives`."""
        pose = self._blend.pose(self._weights(time))
        a = pose.a
        a[self._muscles] += self._moves(time).reshape(-1, 6)
        a, clamped = unfolded(a)
        return PosedFrame(a, pose.b + self._jaw(time), self._head(time), np.zeros((2, 3)), clamped)


def from_keys(
    keys: Sequence[Key],
    poses: Mapping[str, Pose],
    model: SubjectModel,
    times: Floats,
    *,
    head: Sequence[HeadKey] = (),
    interpolation: Interpolation = "smooth",
) -> KeyedDrives:
    """Return what ``keys`` say, with frames at ``times`` (f,) in s.

    Weights of the expressions ``poses``, activations and jaw are interpolated, each by itself;
    before the first key they are as there, after the last as there, at rest if there is none. The
    ``head`` turns about the neck. Raises :class:`InputError`: ``scene.times`` for keys that are not
    one after the other, ``scene.expression`` and ``scene.muscle`` for names that are not known.
    """
    motion = HeadMotion(head, neck(model), interpolation)
    return KeyedDrives(keys, poses, model, times, motion, interpolation)


def _named(mappings: Iterable[Mapping[str, object]]) -> list[str]:
    """Return all names, in the order in which they come."""
    return list(dict.fromkeys(name for names in mappings for name in names))


def _check_names(keys: Sequence[Key], poses: Mapping[str, Pose], model: SubjectModel) -> None:
    for number, key in enumerate(keys):
        for code, noun, names, known in (
            ("scene.expression", "expression", key.expressions, list(poses)),
            ("scene.muscle", "muscle", key.activations, list(model.muscle_names)),
        ):
            for name in names:
                if name not in known:
                    raise InputError(
                        code,
                        f"keys[{number}] names the {noun} {name!r}, which is not one of the face's",
                        key=number,
                        found=name,
                        expected=known,
                    )
