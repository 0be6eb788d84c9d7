"""Fitted performances as drives: between their frames, exaggerated, bridged and mixed.

A muscle's activation is carried as log S(a), in which all that is done to it is linear: a gain k
makes S(a)^k = exp(k log S(a)), and from frame to frame, or over a gap, log S goes without a jump,
so that no blend folds a muscle (Arsigny et al. 2006, "Log-Euclidean metrics"). A fibre muscle's
activation is carried as it is: a gain k makes min(k a, 1), and beyond that its whole force-length
curve may be scaled. The head turns about the neck, by its turn and the neck's place from frame to
frame, so that it moves rigidly in between.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from typing_extensions import override

from solver.animation import (
    Drives,
    Interpolation,
    PosedFrame,
    check_muscles,
    neck,
    track,
    turn_about,
)
from solver.animation.blendshapes import unfold
from solver.errors import InputError, quote, quote_names
from solver.fitting.drives import are_fibres
from solver.fitting.drives.six_numbers import LEAST_STRETCH
from solver.fitting.stretches import map_stretches, to_logarithms
from solver.fitting.strips import strip_names
from solver.kinds import FILES
from solver.kinds.scene import PerformanceEntry
from solver.mechanics.boundary import JAW_FREEDOM
from solver.mechanics.fibre_muscle import FibreMuscles
from solver.mechanics.flesh import IDENTITY
from solver.model import SubjectModel, by_muscle, find_muscles
from solver.storage import read_arrays
from solver.surface import Floats, Ints

LEAST_STEP = 1e-6  # s from a frame to the next
FORMATS = FILES["sequence.npz"].formats
MOST_STRETCH = 1.0 / LEAST_STRETCH  # of a muscle, however great its gain


@dataclass(frozen=True)
class FittedSequence:
    """A fitted performance, the scene's ``asset``: f frames of m muscles.

    ``frames`` (f,) are their numbers and ``times`` (f,) in s; ``fitted`` (f,) is false where there
    was no data to fit. ``shapes`` (K,) are the names of what weights were fitted of, none of
    muscles; ``controls`` (f, K + 5), or (f, 0), are these weights and the jaw on top of theirs.
    ``activations`` (f, m, 6), or (f, m) of fibre muscles, ``jaw`` (f, 5) and
    ``head`` (f, 6) are as in :class:`solver.rig.frames.SequenceFrame`.
    """

    asset: str
    muscles: tuple[str, ...]
    frames: Ints
    times: Floats
    fitted: np.ndarray
    activations: Floats
    jaw: Floats
    head: Floats
    shapes: tuple[str, ...]
    controls: Floats

    @property
    def of_fibres(self) -> bool:
        """Tell whether the muscles are fibre muscles, of one activation each."""
        return are_fibres(self.activations)

    @classmethod
    def load(cls, path: Path, asset: str) -> FittedSequence:
        """Read a ``sequence.npz``.

        Raises :class:`InputError`: ``sequence.unreadable`` if it is none, ``sequence.format`` if it
        is of a later version.
        """
        names = {"file": path.name, "asset": asset}
        try:
            data = read_arrays(path)
            version = int(data["format"])
            found = _sequence(asset, data) if version in FORMATS else None
        except (LookupError, OverflowError, TypeError, ValueError) as error:
            reason = error.args[0] if isinstance(error, ValueError) else f"it has no {quote(error)}"
            message = f"the asset {asset!r}, {path.name}, is not a fitted sequence: {reason}"
            raise InputError("sequence.unreadable", message, **names) from error
        if found is None:
            reason = f"has the sequence format {version}, not one of {list(FORMATS)}"
            raise InputError(
                "sequence.format", f"the asset {asset!r}, {path.name}, {reason}", **names
            )
        return found

    def part(self, chosen: Any) -> FittedSequence:
        """Return some of the frames."""
        names = ("frames", "times", "fitted", "activations", "jaw", "head", "controls")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})

    def played(self, entry: PerformanceEntry) -> PlayedFrames:
        """Return the frames that a scene's ``entry`` plays.

        Raises :class:`InputError`: ``scene.frames`` if there are no such frames, and as
        :func:`_find_bridges` and :meth:`check_values`.
        """
        first = int(self.frames[0])
        last = int(self.frames[-1])
        start = first if entry.start is None else entry.start
        end = last + 1 if entry.end is None else entry.end
        chosen = (self.frames >= start) & (self.frames < end)
        if start < first or end > last + 1 or not chosen.any():
            asked = f"start {start} and end {end} are not within it, or no frame lies between"
            asked = f"end {end} is not after start {start}" if end <= start else asked
            reason = f"the performance {self.asset!r} has the frames {first} to {last}: {asked}"
            more = {"asset": self.asset, "start": start, "end": end}
            raise InputError("scene.frames", reason, expected=len(self.frames), **more)
        played = self.part(chosen)
        kept = ~_find_bridges(played, entry)
        left = played.part(kept)
        left.check_values()
        times = (played.times - played.times[0]) / entry.speed
        return PlayedFrames(times, times[kept], played.frames[~kept], left)

    def places_of(self, names: Sequence[str]) -> list[int]:
        """Return where a face's muscles are among those of the sequence.

        Raises :class:`InputError` (``sequence.muscles``) if it has others.
        """
        other = sorted(set(names) ^ set(self.muscles))
        if other:
            whose = "of the performance" if other[0] in self.muscles else "of the rig"
            reason = f"the performance {self.asset!r} was fitted with another anatomy: the muscle "
            message = f"{reason}{quote(other[0])!r} is only one {whose}"
            more = {"asset": self.asset, "found": quote_names(other)}
            raise InputError("sequence.muscles", message, **more)
        place = {name: number for number, name in enumerate(self.muscles)}
        return [place[name] for name in names]

    def check_values(self) -> None:
        """Raise :class:`InputError` (``sequence.values``) for a number that is none."""
        for name, values in (
            ("activations", self.activations),
            ("jaw", self.jaw),
            ("head", self.head),
            ("weights", self.controls),
        ):
            bad = np.argwhere(~np.isfinite(values))
            if len(bad):
                frame = int(self.frames[bad[0, 0]])
                muscle = None
                what = f"its {name}"
                if name == "activations":
                    muscle = self.muscles[bad[0, 1]]
                    what = f"the activation of {muscle!r}"
                message = f"frame {frame} of the performance {self.asset!r}: {what} is no number"
                more = {"asset": self.asset, "frame": frame, "muscle": muscle}
                raise InputError("sequence.values", message, **more)


@dataclass(frozen=True)
class PlayedFrames:
    """Frames of a sequence as a scene plays them, the first at time 0.

    ``times`` (f,) are in s, ``moments`` (k,) those of the frames that are ``left`` to be played as
    fitted; the others, ``bridged`` (f - k,), are blended over.
    """

    times: Floats
    moments: Floats
    bridged: Ints
    left: FittedSequence


def _sequence(asset: str, data: dict[str, np.ndarray]) -> FittedSequence:
    """Return the sequence of a file's arrays; raises LookupError or ValueError in words."""
    muscles = tuple(str(name) for name in np.atleast_1d(data["muscles"]))
    frames = data["frame"].astype(np.int64)
    times = data["time"].astype(np.float64)
    count = len(np.atleast_1d(frames))
    shapes = {"frame": (), "time": (), "status": (), "jaw": (JAW_FREEDOM,), "head": (6,)}
    entries = () if are_fibres(data["activations"]) else (6,)
    for name, shape in {**shapes, "activations": (len(muscles), *entries)}.items():
        if data[name].shape != (count, *shape):
            raise ValueError(f"its {name} has the shape {data[name].shape}, not {(count, *shape)}")
    if not count:
        raise ValueError("it has no frames")
    is_later = (np.diff(times) >= LEAST_STEP).all() and (np.diff(frames) > 0).all()
    # a bound on times, as differences of huge ones are none
    if not ((np.abs(times) < 1e9).all() and is_later):
        raise ValueError("its frames are not one after the other in number and time")
    values = {name: data[name].astype(np.float64) for name in ("activations", "jaw", "head")}
    fitted = np.isin(data["status"].astype(np.str_), ("fitted", "smoothed"))
    names = tuple(str(name) for name in np.atleast_1d(data.get("shapes", [])))
    controls = np.zeros((count, 0))
    if "weights" in data:
        controls = np.hstack([data["weights"], data["jaw_on_top"]]).astype(np.float64)
        if controls.shape != (count, len(names) + JAW_FREEDOM):
            raise ValueError(f"its weights are not of the {len(names)} shapes that it names")
    more: dict[str, Any] = {"shapes": names, "controls": controls, **values}
    return FittedSequence(asset, muscles, frames, times, fitted, **more)


def from_logarithms(logarithms: Floats) -> tuple[Floats, int]:
    """Return the activations (n, 6) of logarithms, and how many muscles were kept from folding."""
    most = np.log(MOST_STRETCH)
    return unfold(map_stretches(logarithms, lambda values: np.exp(np.minimum(values, most))))


class PlayedPerformance(Drives):
    """:class:`Drives` of a fitted ``sequence``, played by a scene's ``entry``.

    Its first frame is at time 0. ``frames`` (f,) are the numbers of those that are played as
    fitted, with their ``jaw`` (f, 5); the ``bridged`` (b,) between them are blended over. A
    sequence of fibre muscles is one of ``fibres``, the person's; ``curve`` (m,) are the factors of
    their force-length curves. Raises :class:`InputError`: ``scene.frames``, ``scene.muscle``,
    ``scene.shapes``, ``scene.curve``, ``scene.fibres``, ``scene.bridges``, ``sequence.muscles`` and
    ``sequence.values``.
    """

    def __init__(
        self,
        sequence: FittedSequence,
        entry: PerformanceEntry,
        model: SubjectModel,
        interpolation: Interpolation = "smooth",
        fibres: FibreMuscles | None = None,
    ) -> None:
        self.entry = entry
        self.of_fibres = sequence.of_fibres
        if sequence.shapes:
            reason = f"the performance {entry.asset!r} was fitted by weights of shapes"
            raise InputError("scene.shapes", f'{reason}: set "drive" to "tracks"')
        self.muscles = _muscles_of(sequence, model, fibres)
        gains = _factors(entry.muscles, "muscles", entry, self.muscles) * entry.gain
        self.curve = _curve(entry, self.muscles, of_fibres=self.of_fibres)
        places = sequence.places_of(self.muscles)
        played = sequence.played(entry)
        left = played.left
        self.times: Floats = played.times
        self.bridged = played.bridged
        self.frames = left.frames
        self.jaw = left.jaw
        self._neck = neck(model)
        self._start, turns, moves = played_head(left.head, self._neck, entry)
        moments = played.moments
        activations = left.activations[:, places]
        if self.of_fibres:
            strong = np.minimum(gains * activations, 1.0)
        else:
            entries = activations.reshape(-1, 6)
            logarithms = to_logarithms(entries, LEAST_STRETCH, MOST_STRETCH)
            by_muscle = logarithms.reshape(len(moments), -1, 6)
            strong = (gains[:, None] * by_muscle).reshape(len(moments), -1)
        values = np.hstack([strong, left.jaw, turns, moves])
        name = f"performance {entry.asset}"
        self._track = track(moments.tolist(), values, name, interpolation)

    @override
    def __call__(self, time: float) -> PosedFrame:
        carried, jaw, turn, move = np.split(self._track(time), [-JAW_FREEDOM - 6, -6, -3])
        a, clamped = (carried, 0) if self.of_fibres else from_logarithms(carried.reshape(-1, 6))
        turned = (self._start * Rotation.from_rotvec(turn)).as_rotvec()
        head = turn_about(self._neck, turned, move)
        return PosedFrame(a, jaw, head, np.zeros((2, 3)), clamped)


def _muscles_of(
    sequence: FittedSequence, model: SubjectModel, fibres: FibreMuscles | None
) -> tuple[str, ...]:
    """Return the names of the muscles that a sequence has to have."""
    if not sequence.of_fibres:
        return model.muscle_names
    if fibres is None:
        reason = f"the performance {sequence.asset!r} is of fibre muscles, and the rig has none"
        message = f"{reason} that are calibrated: run fit_fibres, or give its fibre_muscles.npz"
        raise InputError("scene.fibres", message, asset=sequence.asset)
    return strip_names(model.muscle_names, fibres)


def _factors(
    given: Mapping[str, float], what: str, entry: PerformanceEntry, muscles: Sequence[str]
) -> Floats:
    """Return a factor for every muscle (m,); a compartment without one has its whole muscle's."""
    check_muscles(given, muscles, f"{what} of the performance {entry.asset!r}")
    factors = by_muscle(given, muscles)
    return np.array([factors.get(name, 1.0) for name in muscles])


def _curve(entry: PerformanceEntry, muscles: Sequence[str], *, of_fibres: bool) -> Floats:
    """Return the factors (m,) of the muscles' force-length curves."""
    factors = _factors(entry.curve, "curve", entry, muscles)
    for name in () if of_fibres else entry.curve:
        reason = "has six numbers a muscle, and no force-length curve: use muscles, its gains"
        message = f"curve names {name!r}, but the performance {entry.asset!r} {reason}"
        raise InputError("scene.curve", message, asset=entry.asset, found=name)
    return factors


def _find_bridges(played: FittedSequence, entry: PerformanceEntry) -> np.ndarray:
    """Return which frames (f,) are blended over; raises ``scene.bridges`` where all would be."""
    frames = played.frames
    bridged = ~played.fitted if entry.bridges.missing else np.zeros(len(frames), bool)
    for number, span in enumerate(entry.bridges.spans):
        inside = (frames >= span.start) & (frames < span.end)
        if not inside.any():
            where = f"bridges.spans[{number}] of the performance {entry.asset!r}"
            reason = f"no frame that is played lies from {span.start} to before {span.end}"
            more = {"asset": entry.asset, "start": span.start, "end": span.end}
            raise InputError("scene.bridges", f"{where}: {reason}", **more)
        bridged = bridged | inside
    if bridged.all():
        reason = f"nothing is left of the performance {entry.asset!r}: every frame is bridged"
        raise InputError("scene.bridges", reason, asset=entry.asset)
    return bridged


def played_head(
    head: Floats, pivot: Floats, entry: PerformanceEntry
) -> tuple[Rotation, Floats, Floats]:
    """Return the first turn, those from it on (f, 3), and how far the ``pivot`` moves (f, 3), mm.

    From the first one on a head never turns by half a circle, where rotation vectors jump.
    """
    head = np.zeros_like(head) if entry.head == "still" else head
    turns = Rotation.from_rotvec(head[:, :3])
    shifts = head[:, 3:]
    if entry.head == "from_start":
        back = turns[0].inv()
        turns = back * turns
        shifts = back.apply(shifts - shifts[0])
    start = turns[0]
    return start, (start.inv() * turns).as_rotvec(), turns.apply(pivot) + shifts - pivot


class MixedPerformances(Drives):
    """:class:`Drives` of several ``performances``: each moves the muscles of its mask.

    They move the face by their ``drives``, which add keys to them. Jaw, head and eyes are the
    first's; a muscle that none moves is at rest, ``curve`` (m,) is that of who moves it. Raises
    :class:`InputError`: ``scene.muscle`` for a name that is not known, ``scene.mask`` for a muscle
    that two would move, ``scene.fibres`` where only some are of fibre muscles.
    """

    def __init__(self, performances: Sequence[PlayedPerformance], drives: Sequence[Drives]) -> None:
        self.performances = performances
        first = performances[0]
        other = next((each for each in performances if each.of_fibres != first.of_fibres), None)
        if other:
            names = f"{first.entry.asset!r} and {other.entry.asset!r}"
            reason = f"of the performances {names} one is of fibre muscles, the other is not"
            raise InputError("scene.fibres", reason)
        self.of_fibres = first.of_fibres
        self.times: Floats = max(
            (each.times for each in drives), key=lambda times: float(times[-1])
        )
        self._drives = drives
        self._movers = _movers([each.entry for each in performances], first.muscles)
        self.curve: Floats = np.ones(len(self._movers))
        for number, each in enumerate(performances):
            self.curve[self._movers == number] = each.curve[self._movers == number]

    @override
    def __call__(self, time: float) -> PosedFrame:
        poses = [drives(time) for drives in self._drives]
        a = np.zeros(len(self._movers))
        if not self.of_fibres:
            a = np.tile(IDENTITY, (len(self._movers), 1))
        for number, pose in enumerate(poses):
            own = self._movers == number
            a[own] = pose.a[own]
        first = poses[0]
        return PosedFrame(a, first.jaw, first.head, first.eyes, max(p.clamped for p in poses))


def _movers(entries: Sequence[PerformanceEntry], muscles: Sequence[str]) -> Ints:
    """Return the number of the performance that moves each muscle (m,); -1 is none."""
    movers = np.full(len(muscles), -1)
    rest = [number for number, entry in enumerate(entries) if entry.mask is None]
    if len(rest) > 1:
        names = " and ".join(repr(entries[number].asset) for number in rest[:2])
        reason = f"the performances {names} have no mask: one of them may move all other muscles"
        raise InputError("scene.mask", reason, found=len(rest), expected=1)
    for number, entry in enumerate(entries):
        where = f"the mask of performance[{number}], {entry.asset!r},"
        check_muscles(entry.mask or [], muscles, where)
        for name in entry.mask or []:
            for muscle in find_muscles(name, muscles):
                if movers[muscle] not in (-1, number):
                    other = entries[movers[muscle]].asset
                    reason = f"{where} names {name!r}, which that of {other!r} names too"
                    raise InputError("scene.mask", reason, found=name)
                movers[muscle] = number
    if rest:
        movers[movers < 0] = rest[0]
    return movers
