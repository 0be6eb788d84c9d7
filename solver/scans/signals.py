"""What recordings of faces have in common: rest is taken off, gaps are filled, jitter is taken out.

Signals are measured (:class:`~solver.scans.live_link.FaceTake` as a reader has them) and become
what is played, as a scene's entry asks for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from solver.errors import Finding, InputError, count_words, make_warning
from solver.kinds.scene_recording import Recording
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.surface import Floats


@dataclass(frozen=True)
class SignalOptions:
    """How signals are mended."""

    bridge_s: float = 0.25  # longest gap to blend over, and how long a longer one eases to rest
    rest_percentile: float = 10.0  # of a shape's weights: at rest, where no frame is named
    least_range: float = 0.02  # of a weight in a video: what moves less is not seen by the detector
    # of a weight that is scaled to 1 by its range in the take; a smaller one is noise
    least_scaled: float = 0.05
    smooth_hz: float = 6.0  # of a video's signals, where a scene does not say


SIGNALS = SignalOptions()

# Degrees that an eye has turned where a weight of eyeLookDown or Out is 1, about: slopes in a
# session of Live Link Face, in which both are recorded (correlation 0.995 and 0.999).
LOOK_DEG = {"pitch": 31.0, "yaw": 35.0}


def _columns(name: str) -> list[int]:
    return [ARKIT_NAMES.index(f"{name}{side}") for side in ("Left", "Right")]


LOOKS = {name: _columns(f"eyeLook{name}") for name in ("Down", "Up", "In", "Out")}
PARABOLA = 3  # coefficients
BLINKS = _columns("eyeBlink")
OUTWARD = np.array([1.0, -1.0])  # yaw of the left and the right eye that looks out


def eyes_of(weights: Floats) -> Floats:
    """Return rotation vectors (f, 2, 3), rad, of eyes that look as weights (f, 52) say."""
    down, up, inward, out = (weights[:, LOOKS[name]] for name in ("Down", "Up", "In", "Out"))
    pitch = np.radians(LOOK_DEG["pitch"]) * (down - up)
    yaw = np.radians(LOOK_DEG["yaw"]) * OUTWARD * (out - inward)
    angles = np.column_stack([yaw.ravel(), pitch.ravel()])
    return np.asarray(Rotation.from_euler("YX", angles).as_rotvec().reshape(-1, 2, 3))


def with_looks(weights: Floats, eyes: Floats) -> Floats:
    """Return weights (f, 52) with those of lids that follow turned eyes (f, 2, 3)."""
    x, y, z = np.moveaxis(Rotation.from_rotvec(eyes.reshape(-1, 3)).apply([0.0, 0.0, 1.0]), -1, 0)
    down = np.arctan2(-y, np.hypot(x, z)).reshape(-1, 2) / np.radians(LOOK_DEG["pitch"])
    out = OUTWARD * np.arctan2(x, z).reshape(-1, 2) / np.radians(LOOK_DEG["yaw"])
    followed = weights.copy()
    for name, looks in (("Down", down), ("Up", -down), ("Out", out), ("In", -out)):
        followed[:, LOOKS[name]] = looks.clip(0.0, 1.0)
    return followed


def play_signals(
    file: str, measured: FaceTake, entry: Recording, options: SignalOptions = SIGNALS
) -> FaceTake:
    """Return measured signals as a scene's ``entry`` plays them.

    Rest is taken off a video's signals, and off others' where a frame is named. Raises
    :class:`InputError`: ``<format>.neutral`` where this frame is not there or has no face.
    """
    take = measured
    seen = measured.seen
    is_video = measured.source == "video"
    notices = list(take.notices)
    times = take.times if entry.fps is None else np.arange(len(take.times)) / entry.fps
    weights = take.weights.copy()
    head = take.head
    eyes = take.eyes
    if is_video:
        still = np.ptp(weights[seen], axis=0) < options.least_range
        weights[:, still] = 0.0
    rest = rest_frame(file, take.source, seen, entry.neutral)
    if is_video or rest is not None:
        lowest = np.percentile(weights[seen], options.rest_percentile, axis=0)
        weights = np.maximum(weights - (lowest if rest is None else weights[rest]), 0.0)
        head = _from_rest(head, seen, rest)
        eyes = _looks_from_rest(eyes, seen, rest)
    if entry.camera_pitch_deg is not None:
        head = seen_by(take.head, entry.camera_pitch_deg)
    if entry.gain == "range":
        weights /= np.maximum(weights[seen].max(axis=0), options.least_scaled)
        notices.append(range_notice(file, take.source, "shape"))
    else:
        weights *= entry.gain
    signals = np.hstack([weights, head, eyes.reshape(-1, 6)])
    signals, gaps = fill_gaps(times, signals, seen, options.bridge_s)
    if gaps:
        notices.append(gap_notice(file, take.source, gaps, seen, options.bridge_s))
    hertz = options.smooth_hz if is_video and entry.smooth_hz is None else entry.smooth_hz
    if hertz:
        signals = smoothed(times, signals, hertz)
    weights, head, turns = np.split(signals, [-9, -6], axis=1)
    return replace(
        take,
        times=times,
        weights=weights,
        head=head,
        eyes=turns.reshape(-1, 2, 3),
        gaps=gaps,
        notices=tuple(notices),
    )


def rest_frame(file: str, source: str, seen: np.ndarray, neutral: int | str) -> int | None:
    """Return the frame in which the face is at rest; None where it is estimated."""
    if isinstance(neutral, str):
        return None
    if neutral >= len(seen):
        reason = f"it has the frames 0 to {len(seen) - 1}, and none {neutral} to be neutral"
        about = {"found": neutral, "expected": len(seen)}
    elif not seen[neutral]:
        reason = f"no face is seen in the frame {neutral}, to be neutral"
        about = {"found": neutral}
    else:
        return neutral
    raise InputError(f"{source}.neutral", f"{file}: {reason}", file=file, **about)


def _from_rest(turns: Floats, seen: np.ndarray, rest: int | None) -> Floats:
    """Return rotation vectors (f, 3) from that of a frame on, or from the mean."""
    each = Rotation.from_rotvec(turns)
    still = each[seen].mean() if rest is None else each[rest]
    return np.asarray((still.inv() * each).as_rotvec())


def _looks_from_rest(eyes: Floats, seen: np.ndarray, rest: int | None) -> Floats:
    """Return the eyes' vectors (f, 2, 3), less the median look or that of a frame."""
    still = np.median(eyes[seen], axis=0) if rest is None else eyes[rest]
    return np.asarray(eyes - still)


def seen_by(turns: Floats, pitch_deg: float) -> Floats:
    """Return turns (f, 3) in the world, seen by a camera that looks up by ``pitch_deg``."""
    camera = Rotation.from_rotvec([np.radians(pitch_deg), 0.0, 0.0])
    return np.asarray((camera * Rotation.from_rotvec(turns)).as_rotvec())


def fill_gaps(
    times: Floats, values: Floats, seen: np.ndarray, bridge_s: float
) -> tuple[Floats, tuple[float, ...]]:
    """Return values (f, c) with those that were not seen filled in, and the gaps' lengths in s.

    A gap of at most ``bridge_s`` from a seen frame to the next is crossed on a straight line. In a
    longer one, and at the ends, values ease to zero, rest, and from there, within this time.
    """
    filled = values.copy()
    lengths = []
    edges = np.flatnonzero(np.diff(np.concatenate([[True], seen, [True]])))
    for begin, end in edges.reshape(-1, 2).tolist():
        inside = times[begin:end]
        since = inside - times[begin - 1] if begin else np.full(len(inside), np.inf)
        until = times[end] - inside if end < len(times) else np.full(len(inside), np.inf)
        lengths.append(float(times[min(end, len(times) - 1)] - times[max(begin - 1, 0)]))
        whole = float(since[0] + until[0])
        if whole <= bridge_s * (1.0 + 1e-9):
            left = until / whole
            right = since / whole
        else:
            left = _ease(since / bridge_s)
            right = _ease(until / bridge_s)
        before = values[max(begin - 1, 0)]
        after = values[min(end, len(times) - 1)]
        filled[begin:end] = np.outer(left, before) + np.outer(right, after)
    return filled, tuple(lengths)


def _ease(along: Floats) -> Floats:
    """Return a weight that goes smoothly from 1 at 0 to 0 from 1 on."""
    along = np.minimum(along, 1.0)
    return np.asarray(1.0 - along**2 * (3.0 - 2.0 * along))


def smoothed(times: Floats, signals: Floats, hertz: float) -> Floats:
    """Return weights and turns (f, 52 + 9) as :func:`low_pass` does, but blinks as they are.

    A blink takes a tenth of a second: its lids would no longer close.
    """
    steady = low_pass(times, signals, hertz)
    steady[:, BLINKS] = signals[:, BLINKS]
    return steady


def low_pass(times: Floats, values: Floats, hertz: float, reach: float = 3.0) -> Floats:
    """Return values (f, c) without what is faster than ``hertz``, which is halved in power.

    Each is that at its own time of a parabola through its neighbours, weighted by a Gaussian: times
    may lie apart as they like, peaks hardly lose height, and nothing comes later than it was. The
    Gaussian has a ``reach`` of so many deviations.
    """
    # (1 + u) exp(-u), with u half the square of a frequency by the deviation, is what such a
    # parabola leaves of it: 0.5 ** 0.5 at 1.0785
    deviation = np.sqrt(2.0 * 1.0785) / (2.0 * np.pi * hertz)
    first = np.searchsorted(times, times - reach * deviation)
    last = np.searchsorted(times, times + reach * deviation, side="right")
    spans = np.gradient(times) if len(times) > 1 else np.ones(1)  # that each frame stands for
    smooth = values.copy()
    for frame, (begin, end) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        if end - begin < PARABOLA:
            continue
        since = (times[begin:end] - times[frame]) / deviation
        powers = since ** np.arange(PARABOLA)[:, None]
        weighted = powers * (np.exp(-0.5 * since**2) * spans[begin:end])
        kernel = np.linalg.solve(weighted @ powers.T, weighted)[0]
        smooth[frame] = kernel @ values[begin:end]
    return smooth


def gap_notice(
    file: str, source: str, gaps: Sequence[float], seen: np.ndarray, bridge_s: float
) -> Finding:
    """Return the notice that in some frames no face is seen."""
    missing = int((~seen).sum())
    frames = f"no face is seen in {missing:,} of {len(seen):,} frames"
    where = f"{count_words(len(gaps), 'gap', 'gaps')}, the longest of {max(gaps):.2f} s"
    words = f"{file}: {frames}, in {where}: up to {bridge_s:g} s are blended over, longer ones "
    more = {"file": file, "count": missing, "gaps": len(gaps), "longest_gap_s": max(gaps)}
    return make_warning(f"{source}.gaps", f"{words}eased to rest", more)


def range_notice(file: str, source: str, noun: str) -> Finding:
    """Return the notice that weights are scaled by their range."""
    words = f"{file}: every {noun} is scaled by its range in this take, so that a "
    words += "faint expression is played as a full one"
    return make_warning(f"{source}.range", words, {"file": file})
