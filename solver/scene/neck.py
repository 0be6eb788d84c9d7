"""A head that a neck carries: what drives ask of the head becomes the goal of a neck."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from solver.animation import Drives, on_lines
from solver.animation import neck as pivot_of
from solver.errors import Finding, make_warning
from solver.fitting.face import HungSkin
from solver.kinds.scene import Force, GravityEntry, PullEntry, WindEntry
from solver.kinds.scene_neck import HeadPush, NeckEntry
from solver.model import SubjectModel
from solver.neck.anatomy import Neck, NeckPose
from solver.neck.builtin import builtin_neck
from solver.neck.motion import (
    HeadGoal,
    MotionOptions,
    NeckMotion,
    Push,
    follow,
    reachable,
    tell_behind,
)
from solver.neck.osim import read_osim
from solver.neck.place import find_rim, head_joint, place_neck
from solver.neck.posture import share_out
from solver.neck.reflex import ReflexOptions
from solver.neck.skin import NeckSkin
from solver.neck.voluntary import VoluntaryOptions
from solver.progress import ProgressCallback, silent
from solver.scene.places import Places
from solver.similarity import Similarity
from solver.surface import Floats

STILL_MM = 0.5  # moves of a head that nobody sees
MILLI = 1e-3  # of seconds, metres or newtons in the scene's unit


class CarriedHead:
    """The motion of a head and its neck over all moments of a scene, known before it is played.

    ``drives`` ask for turns of the head, whose moves are out of a neck's reach; there are ``steps``
    of the simulation from frame to frame, in which joints turn steadily. Raises
    :class:`InputError`: ``neck.skin`` for a skin that ends in no neck, ``neck.osim`` and
    ``neck.extra``, and as :meth:`Places.asset` and :meth:`Places.point`.
    """

    def __init__(
        self,
        entry: NeckEntry,
        places: Places,
        model: SubjectModel,
        drives: Drives,
        steps: int,
        forces: Sequence[Force] = (),
        progress: ProgressCallback = silent,
    ) -> None:
        self.model = model
        joint = head_joint(model)
        neck = builtin_neck() if entry.asset is None else read_osim(places.asset(entry.asset))
        rim = find_rim(model, joint) if entry.skin else None
        self.placed = place_neck(model, neck, rim)
        self.skin = None if rim is None else NeckSkin.of(model, self.placed.neck, rim)
        self._coupled = entry.coupling and self.skin is not None
        heads = [drives(time).head for time in drives.times.tolist()]
        pivot = pivot_of(model)[None]
        self._moved_mm = np.array([np.linalg.norm(head(pivot) - pivot) for head in heads])
        asked = Rotation.from_matrix([head.rotation for head in heads]).as_rotvec()
        self._options = options_of(entry)
        self._steps = steps
        self._has_wind = entry.muscles and any(isinstance(force, WindEntry) for force in forces)
        self._goal = reachable(self.placed.neck, drives.times, asked, self._options)
        goal = _between_frames(self._goal, steps)
        pushes = [push_of(push, places) for push in entry.pushes]
        pushes += [pull_of(force, places) for force in forces if isinstance(force, PullEntry)]
        if entry.muscles:
            gravity = gravity_of(forces)
            self.motion = follow(self.placed.neck, goal, self._options, gravity, pushes, progress)
        else:
            self.motion = _share_out(self.placed.neck, goal)
        self.pose = lru_cache(maxsize=4)(self._pose)

    def _pose(self, time: float) -> NeckPose:
        """Return the neck at ``time`` in s."""
        return self.placed.neck.pose(on_lines(self.motion.times, self.motion.turns, time))

    def head(self, time: float) -> Similarity:
        """Return the head's motion into the world, in which the torso stands still."""
        matrix = self.pose(time).matrices[-1]
        return Similarity(1.0, matrix[:3, :3], matrix[:3, 3])

    def carried(self, time: float) -> Floats | None:
        """Return how far the flesh's vertices (p, 3) are carried in the head's frame, mm."""
        if self.skin is None or not self._coupled:
            return None
        carried = self.skin.carry_flesh(self.pose(time).matrices)
        return np.asarray(self.head(time).inverse()(carried) - self.model.rest)

    @property
    def pull(self) -> Floats | None:
        """Return how much the skin of the neck pulls the flesh's vertices (p,), Pa mm."""
        return self.skin.pull() if self.skin is not None and self._coupled else None

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

    def activations(self, time: float) -> Floats:
        """Return the activations (m,) of the neck's muscles at ``time``; none without them."""
        return on_lines(self.motion.times, self.motion.activations, time)

    @property
    def notices(self) -> list[Finding]:
        """Return what of the head's motion was out of range or reach, and what was read."""
        told = [make_warning("neck.source", words) for words in self.placed.neck.notices]
        if self._has_wind:
            message = "wind acts on the flesh alone, not on the neck"
            told.append(make_warning("neck.forces", message, {"kinds": ["wind"]}))
        moved = self._moved_mm > STILL_MM
        if moved.any():
            most = float(self._moved_mm.max())
            first = int(moved.argmax())
            count = int(moved.sum())
            words = f"{count} frames move the head by up to {most:.0f} mm, which no neck does"
            message = f"{words}: it turns alone, first frame {first}"
            context = {"count": count, "first_frame": first, "moved_mm": round(most, 2)}
            told.append(make_warning("neck.reach", message, context))
        behind = tell_behind(self.motion.off_deg[:: self._steps], self._options)
        return [*told, *self._goal.notices, *behind]

    def arrays(self, times: Floats) -> dict[str, np.ndarray]:
        """Return what ``animation.npz`` has of a neck, with a row for each of ``times`` (f,)."""
        poses = [self.pose(time) for time in times.tolist()]
        turned = Rotation.from_matrix(np.concatenate([pose.rotations for pose in poses]))
        places = np.array([pose.places[1:] for pose in poses])
        vertebrae = np.concatenate([turned.as_rotvec().reshape(places.shape), places], axis=2)
        found = {"vertebrae": vertebrae, "head_held": self._goal.held}
        if self.motion.activations.shape[1]:
            found["neck_activations"] = np.array([self.activations(t) for t in times.tolist()])
        return found

    @property
    def words(self) -> str:
        """Return where the neck is from, and its size, in words."""
        neck = self.placed.neck
        scale = self.placed.placed.scale
        count = self.motion.activations.shape[1]
        moved = f"moved by {count} muscles" if count else "joints share out the turns of the head"
        return f"{neck.source}, {scale:.2f} times its size; {moved}"

    def report(self) -> dict[str, Any]:
        """Return the place of the neck, how the head was followed, and what it could not do."""
        motion = self.motion
        neck = self.placed.neck
        figures = {
            **self.placed.report(),
            "muscles": [muscle.name for muscle in neck.muscles] if motion.activations.size else [],
            "held_frames": int(self._goal.held.sum()),
        }
        if motion.activations.size:
            followed = motion.figures
            names = ("rms_deg", "max_deg", "activation_mean", "activation_max")
            figures |= {name: round(float(followed[name]), 4) for name in names}
        return figures


def options_of(entry: NeckEntry) -> MotionOptions:
    """Return how a scene's neck follows its goal: what has no mass follows it as it is."""
    if not entry.muscles:
        return MotionOptions(range_part=1.0, smooth_hz=0.0)
    return MotionOptions(
        voluntary=VoluntaryOptions(rate_hz=entry.voluntary_hz, cocontraction=entry.cocontraction),
        reflex=ReflexOptions(
            rate_hz=entry.reflex_hz,
            strain=entry.reflex_strain,
            strain_rate=entry.reflex_strain_rate,
            delay_s=MILLI * entry.reflex_delay_ms,
        ),
    )


def gravity_of(forces: Sequence[Force]) -> Floats | None:
    """Return the acceleration (3,) in m/s^2 of a scene's gravity; None where it names none."""
    named = [force.mm_s2 for force in forces if isinstance(force, GravityEntry)]
    return MILLI * np.sum(named, axis=0) if named else None


def push_of(entry: HeadPush, places: Places) -> Push:
    """Return a push on the head that a scene describes; raises as :meth:`Places.point`."""
    end = entry.time + entry.seconds
    return Push(entry.time, end, np.array(entry.newtons), places.point(entry.at))


def pull_of(entry: PullEntry, places: Places) -> Push:
    """Return what a pull at the skin does to the head; raises as :meth:`Places.vertex`."""
    point = places.model.skin.vertices[places.vertex(entry.at)]
    newtons = MILLI * np.array(entry.mn)
    return Push(-np.inf, np.inf, newtons, point, ramp_s=entry.ramp, turns_with_head=True)


def _share_out(neck: Neck, goal: HeadGoal) -> NeckMotion:
    """Return the motion of joints that share a goal's turns, without muscles."""
    matrices = (goal(time).as_matrix() for time in goal.times.tolist())
    turns = np.array([share_out(neck, matrix).turns for matrix in matrices])
    frames = len(goal.times)
    return NeckMotion(goal.times, turns, np.zeros((frames, 0)), np.zeros(frames), goal, neck)


def _between_frames(goal: HeadGoal, steps: int) -> HeadGoal:
    """Return a goal at the moments of a simulation with so many ``steps`` between two frames."""
    if steps == 1 or len(goal.times) == 1:
        return goal
    inner = [np.linspace(*pair, steps + 1)[:-1] for pair in pairwise(goal.times)]
    times = np.append(np.concatenate(inner), goal.times[-1])
    vectors = np.array([goal(time).as_rotvec() for time in times.tolist()])
    held = np.append(np.repeat(goal.held[:-1] | goal.held[1:], steps), goal.held[-1])
    return replace(goal, times=times, vectors=vectors, held=held)
