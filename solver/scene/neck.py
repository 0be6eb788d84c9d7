"""A head that a neck carries: what drives ask of the head becomes the goal of a neck."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from solver.animation import Drives
from solver.animation import neck as head_pivot
from solver.fitting.face import HungSkin
from solver.kinds.scene import NeckEntry
from solver.model import SubjectModel
from solver.neck.anatomy import BODIES, Neck, NeckPose
from solver.neck.kinematic import count_beyond, share_motion
from solver.neck.place import find_rim, head_joint, place_neck
from solver.neck.skin import NeckSkin
from solver.scene.places import Places
from solver.similarity import Similarity
from solver.surface import Floats


class CarriedHead:
    """The motion of a head and its neck over all moments of a scene, known before it is played.

    Heads turn as the neck can: ``drives`` ask for turns, of which moves are out of reach. Between
    the moments of the simulation joints turn steadily. Raises :class:`InputError` (``neck.skin``)
    for a skin that ends in no neck, and as :meth:`Places.asset`.
    """

    def __init__(
        self, entry: NeckEntry, places: Places, model: SubjectModel, drives: Drives, steps: int
    ) -> None:
        neck = read_neck(entry, places)
        joint = head_joint(model)
        rim = find_rim(model, joint) if entry.skin else None
        self.placed = place_neck(model, neck, rim)
        self.skin = None if rim is None else NeckSkin.of(model, self.placed.neck, rim)
        self._coupled = entry.coupling and self.skin is not None
        self._model = model
        times = moments(drives.times, steps)
        heads = [drives(float(time)).head for time in times]
        goals = np.array([head.rotation for head in heads])
        self._moved_mm = _moves(heads, head_pivot(model))
        self.motion = share_motion(self.placed.neck, times, goals)
        self._frames = slice(None, None, steps)
        self.pose = lru_cache(maxsize=4)(self._pose)

    def _pose(self, time: float) -> NeckPose:
        """Return the neck at ``time`` in s."""
        turns = between(self.motion.times, self.motion.turns, time)
        return self.placed.neck.pose(turns)

    def head(self, time: float) -> Similarity:
        """Return the head's motion into the world, in which the torso stands still."""
        matrix = self.pose(time).matrices[-1]
        return Similarity(1.0, matrix[:3, :3], matrix[:3, 3])

    def cut(self, time: float) -> Floats | None:
        """Return how far the flesh's cut (c, 3) is displaced in the head's frame, mm."""
        if self.skin is None or not self._coupled:
            return None
        cut = self.skin.cut(self.pose(time).matrices)
        return np.asarray(self.head(time).inverse()(cut) - self._model.rest[self._model.cut])

    def hung(self, time: float) -> HungSkin | None:
        """Return the skin as the vertebrae have it, in the head's frame; None: as the head's."""
        if self.skin is None:
            return None
        skin = self.skin.skin(self.pose(time).matrices)
        return HungSkin(self.head(time).inverse()(skin), self.skin.loose)

    def unposed(self, time: float, skin: Floats) -> Floats:
        """Return the skin (V, 3) at rest that the joints take to ``skin``, in the head's frame."""
        if self.skin is None:
            return skin
        return self.skin.unposed(self.pose(time).matrices, self.head(time)(skin))

    def arrays(self, times: Floats) -> dict[str, np.ndarray]:
        """Return what ``animation.npz`` has of a neck, with a row for each of ``times`` (f,)."""
        poses = [self.pose(time) for time in times.tolist()]
        turned = Rotation.from_matrix(np.concatenate([pose.rotations for pose in poses]))
        places = np.array([pose.places[1:] for pose in poses])
        vertebrae = np.concatenate([turned.as_rotvec().reshape(places.shape), places], axis=2)
        beyond = np.interp(times, self.motion.times, self.motion.beyond)
        return {"vertebrae": vertebrae, "beyond_range_deg": np.degrees(beyond)}

    def report(self) -> dict[str, Any]:
        """Return the place of the neck, and what was out of range or reach."""
        return {
            **self.placed.report(),
            **count_beyond(self.motion.beyond[self._frames], self.motion.speed[self._frames]),
            "out_of_reach_mm": round(float(self._moved_mm.max()), 2),
        }


def read_neck(entry: NeckEntry, places: Places) -> Neck:
    """Return the neck that a scene names."""
    raise NotImplementedError


def moments(frames: Floats, steps: int) -> Floats:
    """Return the moments (n,) of a simulation with so many ``steps`` from frame to frame."""
    if len(frames) == 1:
        return frames
    inner = [
        np.linspace(*pair, steps + 1)[:-1] for pair in zip(frames[:-1], frames[1:], strict=True)
    ]
    return np.append(np.concatenate(inner), frames[-1])


def between(times: Floats, table: Floats, time: float) -> Floats:
    """Return a table (n, ...) of ``times`` (n,) at ``time``, on straight lines."""
    after = int(np.clip(np.searchsorted(times, time), 1, max(len(times) - 1, 1)))
    if after >= len(times):
        return np.asarray(table[0])
    span = times[after] - times[after - 1]
    part = float(np.clip((time - times[after - 1]) / span, 0.0, 1.0))
    return np.asarray((1.0 - part) * table[after - 1] + part * table[after])


def _moves(heads: Sequence[Similarity], pivot: Floats) -> Floats:
    """Return how far (n,) heads move the ``pivot`` (3,) about which they turn, mm."""
    return np.array([np.linalg.norm(head(pivot[None])[0] - pivot) for head in heads])
