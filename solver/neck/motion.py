"""A head's motion as a neck carries it: a goal over time becomes a pose of the neck a frame.

What no neck can do is held: a goal beyond the range of motion at the range, one that is too fast at
the greatest speed, and frames without a goal are crossed between those that have one. All of it is
counted, and its first frame told. The same goal gives the same motion, to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import PchipInterpolator, make_smoothing_spline
from scipy.spatial.transform import Rotation

from solver.errors import Finding, InputError, count_words, make_warning
from solver.neck.anatomy import Neck, NeckPose
from solver.neck.dynamics import Dynamics
from solver.neck.hill import HillOptions
from solver.neck.posture import share_out, within
from solver.neck.reflex import ReflexOptions
from solver.neck.voluntary import Voluntary, VoluntaryOptions
from solver.progress import ProgressCallback, Step, silent
from solver.surface import Floats

SPLINE = 5  # points that a smoothing spline needs


@dataclass(frozen=True)
class Push:
    """A force on the head for a while."""

    begin_s: float
    end_s: float
    force: Floats  # (3,) N, in the torso's axes
    point: Floats  # (3,) mm, of the head at rest
    ramp_s: float = 0.0  # from 0 s on, in which it grows
    turns_with_head: bool = False  # whether the force is in the head's axes

    def at(self, time_s: float, head: Floats) -> Floats:
        """Return the force (3,) in the torso's axes at a time, of a ``head`` turned by (3, 3)."""
        force = head @ self.force if self.turns_with_head else self.force
        return np.asarray(grown_part(time_s, self.ramp_s) * force)


def grown_part(time_s: float, ramp_s: float) -> float:
    """Return the part, from 0 to 1, of a force at a time that grows from 0 s on for ``ramp_s``."""
    return min(max(time_s / ramp_s, 0.0), 1.0) if ramp_s else 1.0


@dataclass(frozen=True)
class MotionOptions:
    """How a goal is followed."""

    most_deg_per_s: float = 600.0  # of the goal
    range_part: float = 0.93  # of the range of motion that the goal may use: heads overshoot
    smooth_hz: float = 6.0  # what is faster in a goal is jitter, and half taken out; 0: nothing is
    settle_s: float = 0.6  # at the first goal, before the first frame
    push_steps: int = 10  # time steps after which a push's torques are made anew
    most_s: float = 3600.0  # of a goal
    behind_deg: float = 5.0  # off a goal that a neck can have, beyond which a frame is told
    told_s: float = 1.0  # of motion between two reports of progress
    voluntary: VoluntaryOptions = field(default_factory=VoluntaryOptions)
    reflex: ReflexOptions = field(default_factory=ReflexOptions)
    hill: HillOptions = field(default_factory=HillOptions)


@dataclass(frozen=True)
class HeadGoal:
    """A goal that a neck can have: ``vectors`` (f, 3) of the head at ``times`` (f,) in s."""

    times: Floats
    vectors: Floats  # rotation vectors in rad
    held: np.ndarray  # (f,) whether the range, the speed or a gap changed it
    notices: tuple[Finding, ...]
    curve: Callable[[float], Floats]  # through them, without jitter, between the first and the last

    def __call__(self, time_s: float) -> Rotation:
        """Return the goal at a time; before the first frame and after the last, theirs."""
        at = min(max(time_s, self.times[0]), self.times[-1])
        return Rotation.from_rotvec(self.curve(at))


@dataclass(frozen=True)
class NeckMotion:
    """What a neck did, a row a frame."""

    times: Floats  # (f,) s
    turns: Floats  # (f, 8, 3) rad, each joint's rotation vector
    activations: Floats  # (f, m)
    off_deg: Floats  # (f,) between the head and its goal
    goal: HeadGoal
    neck: Neck

    def pose(self, frame: int) -> NeckPose:
        """Return the pose of a frame."""
        return self.neck.pose(self.turns[frame])

    @property
    def figures(self) -> dict[str, float | int]:
        """Return how well the goal was followed."""
        kept = self.off_deg[~self.goal.held]
        given = kept if len(kept) else np.zeros(1)
        return {
            "frames": len(self.times),
            "held_frames": int(self.goal.held.sum()),
            "rms_deg": float(np.sqrt(np.mean(given**2))),
            "max_deg": float(given.max()),
            "activation_mean": float(self.activations.mean()),
            "activation_max": float(self.activations.max()),
        }


def reachable(
    neck: Neck, times: Floats, vectors: Floats, options: MotionOptions = MotionOptions()
) -> HeadGoal:
    """Return the goal that is nearest to rotation vectors (f, 3) and that a neck can have.

    Rows with NaN are gaps. Raises :class:`InputError`: ``neck.goal`` if no frame has a goal, or
    times do not rise or are too long.
    """
    times = np.asarray(times, float)
    vectors = np.array(vectors, float)
    if len(times) == 0 or not np.isfinite(times).all() or (np.diff(times) <= 0.0).any():
        raise InputError("neck.goal", "the times of the head's goal do not rise")
    if times[-1] - times[0] > options.most_s:
        message = f"the head's goal takes more than {options.most_s:g} s"
        raise InputError("neck.goal", message, expected=options.most_s)
    seen = np.asarray(np.isfinite(vectors).all(axis=1))
    if not seen.any():
        raise InputError("neck.goal", "no frame has a goal for the head")
    notices = []
    if not seen.all():
        for axis in range(3):
            vectors[~seen, axis] = np.interp(times[~seen], times[seen], vectors[seen, axis])
        notices.append(_notice("neck.gap", "had no goal and were crossed", ~seen))
    vectors = Rotation.from_rotvec(vectors).as_rotvec()  # within half a turn
    beyond = np.zeros(len(times), bool)
    slow = np.zeros(len(times), bool)
    most = np.radians(options.most_deg_per_s)
    worst = 0.0
    fastest = 0.0
    for k, vector in enumerate(vectors):
        vector, excess = within(neck, vector, options.range_part)
        beyond[k] = excess > 0.0
        worst = max(worst, excess)
        if k:
            before = Rotation.from_rotvec(vectors[k - 1])
            step = (Rotation.from_rotvec(vector) * before.inv()).as_rotvec()
            speed = float(np.linalg.norm(step) / (times[k] - times[k - 1]))
            if speed > most:
                slow[k] = True
                fastest = max(fastest, speed)
                vector = (Rotation.from_rotvec(step * most / speed) * before).as_rotvec()
                vector, _ = within(neck, vector, options.range_part)
        vectors[k] = vector
    if beyond.any():
        words = f"up to {np.degrees(worst):.1f} degrees beyond the neck's range: held at it"
        notices.append(_notice("neck.range", words, beyond, beyond_deg=np.degrees(worst)))
    if slow.any():
        found = np.degrees(fastest)
        words = f"at up to {found:.0f} deg/s: held at {options.most_deg_per_s:g}"
        notices.append(_notice("neck.speed", words, slow, deg_per_s=found))
    curve = _curve(times, vectors, options.smooth_hz)

    def held(time_s: float) -> Floats:
        return within(neck, curve(time_s), options.range_part)[0]

    return HeadGoal(times, vectors, beyond | slow | ~seen, tuple(notices), held)


def _curve(times: Floats, vectors: Floats, smooth_hz: float) -> Callable[[float], Floats]:
    """Return a curve near to points: min sum |y - y_k|^2 + lambda int |y''|^2.

    It is a filter by 1/(1 + (f/f_0)^4) without phase.
    """
    if len(times) == 1:
        return lambda _: vectors[0]
    if len(times) < SPLINE or smooth_hz <= 0.0:
        return PchipInterpolator(times, vectors)  # type: ignore[no-any-return]
    step = float(np.median(np.diff(times)))
    return make_smoothing_spline(  # type: ignore[no-any-return]
        times, vectors, lam=1.0 / (step * (2.0 * np.pi * smooth_hz) ** 4)
    )


def _notice(code: str, words: str, which: np.ndarray, **more: float) -> Finding:
    first = int(np.argmax(which))
    count = int(which.sum())
    message = f"{count_words(count, 'frame', 'frames')} of the head {words}, first frame {first}"
    rounded = {name: round(float(value), 2) for name, value in more.items()}
    return make_warning(code, message, {"count": count, "first_frame": first, **rounded})


def tell_behind(off_deg: Floats, options: MotionOptions = MotionOptions()) -> list[Finding]:
    """Return a notice of frames that are too far off their goals, ``off_deg`` (f,), if any is."""
    behind = off_deg > options.behind_deg
    if not behind.any():
        return []
    most = float(off_deg.max())
    words = f"up to {most:.1f} degrees from where muscles were to take it"
    return [_notice("neck.behind", words, behind, off_deg=most)]


def follow(
    neck: Neck,
    goal: HeadGoal,
    options: MotionOptions = MotionOptions(),
    gravity: Floats | None = None,
    pushes: Sequence[Push] = (),
    progress: ProgressCallback = silent,
) -> NeckMotion:
    """Return the motion of a neck that follows a goal; ``gravity`` (3,) m/s^2, down for None.

    Raises :class:`InputError`: ``neck.extra`` without MuJoCo, and :class:`SolveError`:
    ``neck.unstable`` and ``neck.voluntary``.
    """
    dynamics = Dynamics(neck, options.reflex, options.hill, gravity)
    dynamics.body.set_pose(share_out(neck, goal(goal.times[0]).as_matrix()).turns)
    run = _Run(dynamics, goal, options, pushes)
    run.to(goal.times[0])
    turns = []
    activations = []
    off: list[float] = []
    begin, end = goal.times[[0, -1]].tolist()
    told = begin
    for time_s in goal.times.tolist():
        if time_s >= told:
            part = (time_s - begin) / max(end - begin, options.told_s)
            words = f"{time_s - begin:.1f} of {end - begin:.1f} s"
            progress(Step("neck", part, message=words))
            told += options.told_s
        run.to(time_s)
        turns.append(dynamics.body.turns)
        activations.append(dynamics.activations.copy())
        head = Rotation.from_matrix(dynamics.body.head)
        asked = Rotation.from_rotvec(goal.vectors[len(off)])
        off.append(float(np.degrees((asked * head.inv()).magnitude())))
    arrays = np.array(turns), np.array(activations), np.array(off)
    return NeckMotion(goal.times, *arrays, goal, neck)


class _Run:
    """Time steps, with ticks of the voluntary layer where they are due."""

    def __init__(
        self, dynamics: Dynamics, goal: HeadGoal, options: MotionOptions, pushes: Sequence[Push]
    ) -> None:
        self.dynamics = dynamics
        self.goal = goal
        self.options = options
        self.voluntary = Voluntary(options.voluntary)
        self.begin = goal.times[0] - options.settle_s
        self.pushes = [(push, self._steps_of(push)) for push in pushes]
        self.step = 0  # that is done
        self.tick = 0  # that comes next

    def _steps_of(self, push: Push) -> range:
        """Return the time steps of a push, one at least of what falls into the motion."""
        rate = self.options.reflex.rate_hz
        last = float(self.goal.times[-1])
        if push.end_s <= self.begin or push.begin_s > last:
            return range(0)
        begin = max(push.begin_s, self.begin)
        end = min(push.end_s, last)
        first = round((begin - self.begin) * rate)
        return range(first, first + max(round((end - begin) * rate), 1))

    def _time(self, step: int) -> float:
        return float(self.begin + step * self.options.reflex.step_s)

    def to(self, time_s: float) -> None:
        """Go on until the step that is nearest to a time."""
        rate = self.options.reflex.rate_hz
        end = round((time_s - self.begin) * rate)
        while self.step < end:
            if self.step >= round(self.tick * rate / self.options.voluntary.rate_hz):
                self.voluntary.plan(self.dynamics, self.goal, self._time(self.step))
                self.tick += 1
            until = min(end, round(self.tick * rate / self.options.voluntary.rate_hz))
            if self.pushes:
                edges = [edge for _, steps in self.pushes for edge in (steps.start, steps.stop)]
                later = [edge for edge in edges if edge > self.step]
                until = min(until, self.step + self.options.push_steps, *later)
                self._push()
            self.dynamics.advance(until - self.step)
            self.step = until

    def _push(self) -> None:
        external = self.dynamics.external
        external[:] = 0.0
        for push, steps in self.pushes:
            if self.step in steps:
                force = push.at(self._time(self.step), self.dynamics.body.head)
                external += self.dynamics.body.push(force, push.point)
