"""Motion of a face over time: between keys of a scene, and of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation
from typing_extensions import override

from solver.animation.blendshapes import Blend, DrivenShapes, ShapedPose, keep_within, unfold
from solver.errors import InputError
from solver.fitting.face import Pose
from solver.fitting.interior_point import FeasibleSet
from solver.mechanics.flesh import IDENTITY
from solver.model import SubjectModel, by_muscle, find_muscles, tell_muscles
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.similarity import IDENTITY as HEAD_AT_REST
from solver.similarity import Similarity
from solver.surface import Floats, nearest_sphere
from solver.templates.ict_facekit import arkit_source


@dataclass(frozen=True)
class PosedFrame:
    """Activations ``a`` (m, 6), ``jaw`` (5,), ``head`` into the world (scale 1), ``eyes`` (2, 3).

    Activations of fibre muscles are (m,), in [0, 1]. Eyes, the subject's left one first, are
    rotation vectors in radians in the head's frame. ``clamped`` counts the muscles that were kept
    within their limits, or from folding (:func:`keep_within`). ``target`` (p, 3) is where tracks
    pull the flesh, in the head's frame, if tracks drive it.
    """

    a: Floats
    jaw: Floats
    head: Similarity
    eyes: Floats
    clamped: int = 0
    target: Floats | None = None

    @classmethod
    def of(cls, pose: ShapedPose) -> PosedFrame:
        """Return a frame of a pose, head and eyes as at rest."""
        at_rest = HEAD_AT_REST, np.zeros((2, 3))
        return cls(pose.a, pose.jaw, *at_rest, pose.clamped, pose.target)


class Drives(Protocol):
    """Motion of a face at any time; ``times`` (f,) in seconds are those of its frames."""

    times: Floats

    def __call__(self, time: float) -> PosedFrame:
        """Return the pose at ``time`` in seconds, between frames too."""


# "smooth" is a monotone cubic (Fritsch and Carlson 1980), which goes beyond no key's value
Interpolation = Literal["smooth", "linear"]
SHORTEST_SECONDS = 1e-9  # between two keys: values change at no infinite rate

Track = Callable[[float], Floats]


def track(
    times: Sequence[float], values: Floats, what: str, interpolation: Interpolation = "smooth"
) -> Track:
    """Return values (c,) at any time from ``values`` (k, c) at the keys' ``times`` (k,) in s.

    Before the first key and after the last they are as there, and zero if there is none. Raises
    :class:`InputError` (``scene.times``) if a key is not later than the one before, or its time is
    no number; ``what`` is the list of the keys, as the scene calls it.
    """
    for number, time in enumerate(times):
        if not np.isfinite(time):
            raise InputError("scene.times", f"the time of {what}[{number}] is {time}", key=number)
        if number and time - times[number - 1] < SHORTEST_SECONDS:
            reason = f"{what}[{number}] at {time:g} s is not later than the one before"
            raise InputError("scene.times", reason, key=number)
    if not len(times):
        return lambda _time: np.zeros(values.shape[1])
    if len(times) == 1:
        return lambda _time: values[0]
    if interpolation == "linear":
        return partial(on_lines, np.asarray(times), values)
    first = times[0]
    last = times[-1]
    curve = PchipInterpolator(times, values)
    return lambda time: np.asarray(curve(min(max(time, first), last)))


def on_lines(keys: Floats, table: NDArray[np.floating], times: Floats | float) -> Floats:
    """Return a ``table`` (k, ...) of ``keys`` (k,) at ``times`` (...), on straight lines.

    Before the first key and after the last it is as there.
    """
    after = np.clip(np.searchsorted(keys, times), 1, max(len(keys) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(keys) - 1)
    span = np.where(after > before, keys[after] - keys[before], 1.0)
    share = np.clip((times - keys[before]) / span, 0.0, 1.0)
    share = share.reshape(*np.shape(times), *[1] * (table.ndim - 1))
    return np.asarray((1.0 - share) * table[before] + share * table[after])


# heads turn about the upper neck
BELOW_JAW_MM = 40.0  # that is below the middle of the jaw's condyles ...
BEHIND_JAW_MM = 20.0  # ... and behind it


@dataclass(frozen=True)
class HeadKey:
    """Pose of the head at ``time`` in s: turned by ``rotation`` (3,), a vector in rad, and moved.

    ``shift`` (3,) is in mm.
    """

    time: float
    rotation: Floats
    shift: Floats


def neck(model: SubjectModel) -> Floats:
    """Return the point (3,) about which the subject's head turns, mm."""
    return np.asarray(model.jaw.origin - [0.0, BELOW_JAW_MM, BEHIND_JAW_MM])


def turn_about(pivot: Floats, rotation: Floats, shift: Floats) -> Similarity:
    """Return the turn by a rotation vector (3,) about ``pivot`` (3,), and the ``shift`` (3,)."""
    matrix = Rotation.from_rotvec(rotation).as_matrix()
    return Similarity(1.0, matrix, pivot - matrix @ pivot + shift)


def head_motion(
    keys: Sequence[HeadKey], pivot: Floats, interpolation: Interpolation = "smooth"
) -> Callable[[float], Similarity]:
    """Return the head's motion into the world at any time in s, between keys and as at the ends.

    Turns and shifts are interpolated by component. Without a key the head stays where it is. Raises
    as :func:`track`.
    """
    values = [np.concatenate([key.rotation, key.shift]) for key in keys]
    times = [key.time for key in keys]
    place = track(times, np.reshape(values, (len(keys), 6)), "head", interpolation)
    return lambda time: turn_about(pivot, *np.split(place(time), 2))


@dataclass(frozen=True)
class PoseKey:
    """Pose of a face at ``time`` in s; what a key does not name is at rest there.

    ``expressions`` are weights from 0 to 1; ``activations`` are those of single muscles (6,), of
    which what differs from rest is added to the expressions'; so is ``jaw`` (5,), rad and mm.
    ``fibres`` are activations of fibre muscles, which take the place of both, and ``shapes`` are
    weights of the shapes of tracks. The name of a whole muscle means all its compartments and
    strips that are not named themselves.
    """

    time: float
    expressions: Mapping[str, float] = field(default_factory=dict)
    activations: Mapping[str, Floats] = field(default_factory=dict)
    jaw: Floats = field(default_factory=lambda: np.zeros(5))
    fibres: Mapping[str, float] = field(default_factory=dict)
    shapes: Mapping[str, float] = field(default_factory=dict)


class _BlendedKeys:
    """Expressions and single muscles of six numbers each."""

    def __init__(
        self,
        keys: Sequence[PoseKey],
        poses: Mapping[str, Pose],
        model: SubjectModel,
        limits: FeasibleSet | None,
    ) -> None:
        self._limits = limits
        self._used = _names_of(key.expressions for key in keys)
        self._blend = Blend.of({name: poses[name] for name in self._used}, model.muscle_count)
        self._names = model.muscle_names
        self._moved = _names_of(by_muscle(key.activations, self._names) for key in keys)
        self._muscles = [self._names.index(name) for name in self._moved]
        self.size = len(self._used) + 6 * len(self._moved)

    def row(self, key: PoseKey) -> Floats:
        """Return a key's values (c,)."""
        weights = [key.expressions.get(name, 0.0) for name in self._used]
        activations = by_muscle(key.activations, self._names)
        moves = [activations.get(name, IDENTITY) - IDENTITY for name in self._moved]
        return np.concatenate([weights, *moves])

    def pose(self, values: Floats, under: Floats | None) -> tuple[Floats, Floats, int]:
        """Return activations on top of those ``under`` them, the jaw, and who was unfolded."""
        weights, moves = np.split(values, [len(self._used)])
        pose = self._blend.pose(weights)
        pose.a[self._muscles] += moves.reshape(-1, 6)
        if under is None:
            a, clamped = keep_within(pose.a, self._limits)
            return a, pose.b, clamped
        a, clamped = unfold(under + pose.a - IDENTITY)
        if self._limits is None:
            return a, pose.b, clamped
        # what was played stays as it was fitted where no key moves it
        moved = (pose.a != IDENTITY).any(axis=1)
        kept = np.where(moved[:, None], keep_within(a, self._limits)[0], a)
        return kept, pose.b, max(clamped, int((kept != a).any(axis=1).sum()))


class _FibreKeys:
    """Fibre muscles, of one activation each."""

    def __init__(self, keys: Sequence[PoseKey], muscles: Sequence[str]) -> None:
        self._names = muscles
        self._moved = _names_of(by_muscle(key.fibres, muscles) for key in keys)
        self._muscles = [muscles.index(name) for name in self._moved]
        self.size = len(self._moved)

    def row(self, key: PoseKey) -> Floats:
        """Return a key's values (c,)."""
        activations = by_muscle(key.fibres, self._names)
        return np.array([activations.get(name, 0.0) for name in self._moved])

    def pose(self, values: Floats, under: Floats | None) -> tuple[Floats, Floats, int]:
        """Return activations (m,) on top of those ``under`` them, within [0, 1]."""
        a = np.zeros(len(self._names)) if under is None else under.copy()
        a[self._muscles] += values
        return np.clip(a, 0.0, 1.0), np.zeros(5), 0


class KeyedDrives(Drives):
    """:class:`Drives` by ``keys``, with frames at ``times`` (f,) in s.

    Weights of the expressions ``poses``, activations and jaw are interpolated, each by itself, at
    rest if there is no key. The ``head`` turns about the neck. The keys' difference from rest is
    added to other drives, ``under`` them, if there are any; the muscles that keys move stay within
    ``limits``, if they have some. ``fibres`` names the fibre muscles of a face that is moved by
    these; expressions and six numbers are nothing for it. Raises :class:`InputError` as
    :func:`track`, and ``scene.expression`` and ``scene.muscle`` for names that are not known,
    ``scene.fibres`` for what the face is not moved by, in the list of keys that the scene calls
    ``what``.
    """

    def __init__(
        self,
        keys: Sequence[PoseKey],
        poses: Mapping[str, Pose],
        model: SubjectModel,
        times: Floats,
        *,
        head: Sequence[HeadKey] = (),
        interpolation: Interpolation = "smooth",
        under: Drives | None = None,
        what: str = "keys",
        fibres: Sequence[str] | None = None,
        limits: FeasibleSet | None = None,
    ) -> None:
        self.times = times
        self.under = under
        self._head = head_motion(head, neck(model), interpolation)
        _check_names(keys, poses, model, what, fibres)
        self._keys: _BlendedKeys | _FibreKeys = (
            _BlendedKeys(keys, poses, model, limits) if fibres is None else _FibreKeys(keys, fibres)
        )
        rows = [np.concatenate([self._keys.row(key), key.jaw]) for key in keys]
        values = np.reshape(rows, (len(keys), self._keys.size + 5))
        self._track = track([key.time for key in keys], values, what, interpolation)

    @override
    def __call__(self, time: float) -> PosedFrame:
        values, jaw = np.split(self._track(time), [-5])
        under = None if self.under is None else self.under(time)
        a, b, clamped = self._keys.pose(values, None if under is None else under.a)
        head = self._head(time)
        b = b + jaw
        if under is None:
            return PosedFrame(a, b, head, np.zeros((2, 3)), clamped)
        clamped = max(clamped, under.clamped)
        return PosedFrame(a, under.jaw + b, under.head.then(head), under.eyes, clamped)


def _names_of(mappings: Iterable[Mapping[str, object]]) -> list[str]:
    """Return all names, in the order in which they come."""
    return list(dict.fromkeys(name for names in mappings for name in names))


def _check_names(
    keys: Sequence[PoseKey],
    poses: Mapping[str, Pose],
    model: SubjectModel,
    what: str,
    fibres: Sequence[str] | None,
) -> None:
    for number, key in enumerate(keys):
        where = f"{what}[{number}]"
        if fibres is not None and (key.expressions or key.activations):
            reason = "the face is moved by fibre muscles, and these by their activations alone"
            message = f"{where} has expressions or muscles of six numbers, but {reason}: fibres"
            raise InputError("scene.fibres", message, key=number)
        check_muscles(key.fibres, fibres or [], where, key=number)
        check_known(key.expressions, list(poses), "scene.expression", where, key=number)
        check_muscles(key.activations, model.muscle_names, where, key=number)


def check_known(
    names: Iterable[str], known: Sequence[str], code: str, where: str, **context: Any
) -> None:
    """Raise :class:`InputError` (``code``) for the first name of a face that is not ``known``."""
    for name in names:
        if name not in known:
            what = f"{where} names the {code.removeprefix('scene.')} {name!r}"
            reason = f"{what}, which is not one of the face's"
            raise InputError(code, reason, found=name, expected=list(known), **context)


def check_muscles(names: Iterable[str], muscles: Sequence[str], where: str, **context: Any) -> None:
    """Raise :class:`InputError` (``scene.muscle``) for the first name that means no muscle."""
    for name in names:
        if not find_muscles(name, muscles):
            told = tell_muscles(name, muscles)
            reason = f"{where} names the muscle {name!r}, which is not one of the face's; {told}"
            raise InputError("scene.muscle", reason, found=name, expected=list(muscles), **context)


def shape_weights(take: FaceTake, names: Sequence[str]) -> Floats:
    """Return a recording's weights (f, e), from 0 to 1, of the shapes ``names`` of a template.

    Shapes that ARKit does not drive (tracks have some) stay zero.
    """
    sources = [arkit_source(name) for name in names]
    driven = [source in ARKIT_NAMES for source in sources]
    columns = [ARKIT_NAMES.index(source) if source in ARKIT_NAMES else 0 for source in sources]
    return np.asarray(np.clip(take.weights[:, columns], 0.0, 1.0) * driven)


@dataclass(frozen=True, eq=False)
class FrameChanges:
    """Changes of frames' poses: ``activations`` (f, m, 6), and ``jaw`` (f, 5)."""

    activations: Floats
    jaw: Floats


class RecordedDrives(Drives):
    """:class:`Drives` of a recording, from frame ``start`` to before ``end``.

    ``weights`` (f, e) are what drives each of the ``shapes``, by ``names``, in these frames. Times
    begin at 0. Weights and turns between frames lie on straight lines. The recorded head turns
    about the neck; keys of the ``head`` come on top of that. Muscles stay within ``limits``, if
    they have some. ``changes`` are what fits of the frames add to the shapes' poses. Raises
    ``scene.frames`` if there are no such frames.
    """

    def __init__(
        self,
        take: FaceTake,
        shapes: DrivenShapes,
        model: SubjectModel,
        start: int = 0,
        end: int | None = None,
        *,
        head: Sequence[HeadKey] = (),
        limits: FeasibleSet | None = None,
        changes: FrameChanges | None = None,
    ) -> None:
        self._limits = limits
        count = len(take.times)
        last = count if end is None else end
        if not 0 <= start < last <= count:
            asked = f"start {start} and end {last} are not within it"
            if 0 <= last <= start < count:
                asked = f"end {last} is not after start {start}"
            reason = f"the recording has the frames 0 to {count - 1}: {asked}"
            raise InputError("scene.frames", reason, expected=count, start=start, end=last)
        frames = slice(start, last)
        self._shapes = shapes
        self.names = shapes.names
        self.times: Floats = take.times[frames] - take.times[start]
        self.weights: Floats = shape_weights(take, shapes.names)[frames]
        turns = np.hstack([take.head[frames], take.eyes[frames].reshape(-1, 6)])
        values = np.hstack([self.weights, turns])
        self._track = track(self.times, values, "frames", "linear")
        self._changes: Track | None = None
        if changes is not None:
            rows = np.hstack([changes.activations.reshape(len(changes.jaw), -1), changes.jaw])
            self._changes = track(self.times, rows, "frames", "linear")
        self._neck = neck(model)
        self._head = head_motion(head, self._neck)

    def weights_at(self, time: float) -> Floats:
        """Return the weights (e,) of the shapes at ``time`` in s."""
        return self._track(time)[:-9]

    @override
    def __call__(self, time: float) -> PosedFrame:
        weights, head, eyes = np.split(self._track(time), [-9, -6])
        still = PosedFrame.of(self._shapes.pose_of(weights, self._limits))
        if self._changes is not None:
            a, jaw = np.split(self._changes(time), [-5])
            kept, clamped = keep_within(still.a + a.reshape(-1, 6), self._limits)
            still = replace(still, a=kept, jaw=still.jaw + jaw, clamped=max(clamped, still.clamped))
        motion = turn_about(self._neck, head, np.zeros(3)).then(self._head(time))
        return replace(still, head=motion, eyes=eyes.reshape(2, 3))


class Gaze:
    """Turns a subject's eyeballs, the regions ``left_eyeball`` and ``right_eyeball`` if any."""

    def __init__(self, model: SubjectModel) -> None:
        skin = model.skin.vertices
        regions = [model.region(f"{side}_eyeball") for side in ("left", "right")]
        # vertices of each eyeball, and its centre
        self.balls = [(ids, nearest_sphere(skin[ids])[0]) for ids in regions]

    def turn(self, skin: Floats, eyes: Floats) -> Floats:
        """Return a skin (V, 3) in the head's frame with eyes turned by vectors (2, 3) in rad."""
        turned = skin.copy()
        for (ids, centre), vector in zip(self.balls, eyes, strict=True):
            turned[ids] = centre + Rotation.from_rotvec(vector).apply(skin[ids] - centre)
        return turned
