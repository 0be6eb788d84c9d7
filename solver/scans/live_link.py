"""Read and write recordings of Live Link Face: ARKit's 52 weights, head and eyes, as CSV.

Angles are radians, and nobody says about which axes. An eye looks where its weights (eyeLookIn and
so on) of the same frame say if a yaw is positive to the subject's right and a pitch downward; and
in a real recording its turn is free of torsion, to 1e-8, if the matrix is

    R = R_z(-roll) R_y(-yaw) R_x(pitch)

about our axes: x to the subject's left, y up, z forward. The head's angles are taken for the same.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NoReturn

import numpy as np
from scipy.spatial.transform import Rotation

from solver.errors import Finding, InputError, file_error, quote
from solver.surface import Floats

TIMECODE = "timecode"
SEEN = "seen"
SIDED = (
    *("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide"),
    *("mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch", "mouthPress"),
    *("mouthLowerDown", "mouthUpperUp", "browDown", "browOuterUp", "cheekSquint", "noseSneer"),
)
UNSIDED = (
    *("jawForward", "jawRight", "jawLeft", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker"),
    *("mouthRight", "mouthLeft", "mouthRollLower", "mouthRollUpper", "mouthShrugLower"),
    *("mouthShrugUpper", "browInnerUp", "cheekPuff", "tongueOut"),
)
# ARKit's blend shapes; left is the subject's left.
ARKIT_NAMES = (*(name + side for name in SIDED for side in ("Left", "Right")), *UNSIDED)

# Columns of angles, which older recordings do not have.
ANGLES = {
    bone: tuple(f"{bone}{angle}" for angle in ("Yaw", "Pitch", "Roll"))
    for bone in ("head", "leftEye", "rightEye")
}
ANGLE = (-2.0 * np.pi, 2.0 * np.pi)  # beyond them an angle is in degrees, or nothing
WEIGHTS = (-0.5, 1.5)  # a solver goes a little beyond 0 and 1, percents do not fit in
TICKS = 60  # a second in the last part of a timecode, whatever the camera's frame rate is, ...
OTHER_TICKS = (24, 25, 30, 48, 50)  # ... but where the app counts at another rate
UNEVEN = 2.0  # times as long as others, or as short, steps over a second's end are of other ticks
DAY = 86400.0  # s


@dataclass(frozen=True)
class FaceTake:
    """A recording of f frames, whatever wrote it; turns are rotation vectors in radians.

    Their x is to the subject's left, y up, z forward; zero where the file has no columns for them.
    """

    times: Floats  # (f,) in s after the first frame
    weights: Floats  # (f, 52), named ARKIT_NAMES
    head: Floats  # (f, 3)
    eyes: Floats  # (f, 2, 3) in the head, the subject's left one first
    seen: np.ndarray  # (f,) whether there was a face; what others have is filled in
    source: Literal["live_link", "openface", "video"]
    timecodes: tuple[str, ...] = ()  # (f,) as the file has them, or none
    gaps: tuple[float, ...] = ()  # s from a seen frame to the next, with others between
    notices: tuple[Finding, ...] = ()  # what was mended or is doubtful


def read_live_link(path: Path) -> FaceTake:
    """Return a recording; columns may come in any order, others are not read.

    One with a column ``Seen``, 0 or 1, is what :func:`write_signals` left of a video.

    Raises :class:`InputError`: ``live_link.unreadable``, ``live_link.columns`` (one is missing),
    ``live_link.value`` (a field is missing, no number, no weight or no angle),
    ``live_link.timecode`` or ``live_link.time_order`` (a frame is not later than the one before),
    with ``file``, and ``line`` where it is about one.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = csv.reader(file)
            # as ARKit writes names: Live Link Face begins with a capital
            header = [name[:1].lower() + name[1:] for name in map(str.strip, next(rows, ()))]
            _check_columns(path, header)
            columns = {name: header.index(name) for name in ARKIT_NAMES}
            turning = {bone: names for bone, names in ANGLES.items() if set(names) <= set(header)}
            angled = {name: header.index(name) for names in turning.values() for name in names}
            clock = header.index(TIMECODE)
            marks = {SEEN: header.index(SEEN)} if SEEN in header else {}
            times: list[float] = []
            timecodes: list[str] = []
            weights: list[list[float]] = []
            angles: list[list[float]] = []
            seen: list[list[float]] = []
            for row in rows:
                line = rows.line_num
                if row:
                    times.append(_time(path, line, row, clock, times))
                    timecodes.append(row[clock])
                    place = path, line, row
                    weights.append(_numbers(*place, columns, WEIGHTS, "weight from 0 to 1"))
                    angles.append(_numbers(*place, angled, ANGLE, "angle in radians"))
                    seen.append(_numbers(*place, marks, (0.0, 1.0), "0 or 1"))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        message = f"{path.name} is not a recording of Live Link Face, a table of text: {error}"
        raise InputError("live_link.unreadable", message, file=path.name) from error
    if not times:
        raise InputError("live_link.unreadable", f"{path.name} has no frames", file=path.name)
    by_bone = np.array(angles).reshape(len(times), -1, 3).swapaxes(0, 1)
    turns = dict(zip(turning, by_bone, strict=True))
    head, *eyes = (_rotations(turns.get(bone), len(times)) for bone in ANGLES)
    clocked = np.array(times)
    ticks = _ticks_of(clocked)
    since = _in_ticks(clocked, ticks)
    since -= since[0]
    notices = () if ticks == TICKS else (_tell_ticks(path.name, ticks),)
    turned = np.stack(eyes, axis=1)
    signals = since, np.array(weights), head, turned
    if not marks:
        everywhere = np.ones(len(times), bool)
        codes = tuple(timecodes)
        return FaceTake(*signals, everywhere, "live_link", codes, notices=notices)
    shown = np.array(seen).ravel() > 0.5
    if not shown.any():
        message = f"{path.name}: no face is seen in any of its {len(shown)} frames"
        raise InputError("video.no_face", message, file=path.name)
    return FaceTake(*signals, shown, "video")


def _in_ticks(times: Floats, ticks: int) -> Floats:
    """Return times (f,) that were read by :data:`TICKS` a second by ``ticks`` a second."""
    whole = np.floor(times)
    return np.asarray(whole + (times - whole) * TICKS / ticks)


def _ticks_of(times: Floats) -> int:
    """Return how many ticks a second has by times (f,) read by :data:`TICKS`.

    That is what makes steps over a second's end as long as those within a second.
    """
    over = np.diff(np.floor(times)) == 1.0
    if over.sum() < 2 or over.all():
        return TICKS
    most = float(((times - np.floor(times)) * TICKS).max())

    def unevenness(ticks: int) -> float:
        steps = np.diff(_in_ticks(times, ticks))
        ratio = np.median(steps[over]) / np.median(steps[~over])
        return float(max(ratio, 1.0 / ratio)) if ratio > 0.0 else np.inf

    if unevenness(TICKS) < UNEVEN:
        return TICKS
    return min((*(each for each in OTHER_TICKS if each > most), TICKS), key=unevenness)


def _tell_ticks(file: str, ticks: int) -> Finding:
    message = f"{file}: its timecodes count {ticks} ticks a second, by the steps between frames"
    return Finding("live_link.ticks", "info", message, context={"file": file, "found": ticks})


def write_signals(path: Path, take: FaceTake) -> None:
    """Write a recording as :func:`read_live_link` reads it.

    One that is not of Live Link Face has a column ``Seen`` besides; of one that is, frames without
    a face are left out.
    """
    bones = [take.head, take.eyes[:, 0], take.eyes[:, 1]]
    # as _rotations has it
    turns = [Rotation.from_rotvec(each).as_euler("ZYX") * [-1.0, -1.0, 1.0] for each in bones]
    angles = np.hstack([each[:, [1, 2, 0]] for each in turns])
    capital = [name[:1].upper() + name[1:] for name in ARKIT_NAMES]
    marks = [] if take.source == "live_link" else ["Seen"]
    header = [
        TIMECODE.capitalize(),
        *marks,
        *capital,
        *(n for names in ANGLES.values() for n in names),
    ]
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(header)
        for frame, time in enumerate(take.times.tolist()):
            if not (marks or take.seen[frame]):
                continue
            minutes, seconds = divmod(int(time), 60)
            ticks = TICKS * (time - int(time))
            code = f"{minutes // 60:02d}:{minutes % 60:02d}:{seconds:02d}:{ticks:012.9f}"
            values = np.concatenate([take.weights[frame], angles[frame]])
            mark = [int(take.seen[frame])] if marks else []
            rows.writerow([code, *mark, *(f"{value:.9g}" for value in values)])


def _check_columns(path: Path, header: Sequence[str]) -> None:
    missing = [name for name in (TIMECODE, *ARKIT_NAMES) if name not in header]
    if missing:
        message = (
            f"{path.name} is not a recording of Live Link Face: it has no column "
            f"{', '.join(missing[:4])}{' ...' if len(missing) > 4 else ''}"
        )
        raise InputError("live_link.columns", message, file=path.name, line=1, missing=missing)


def _time(path: Path, line: int, row: list[str], column: int, before: Sequence[float]) -> float:
    """Return a frame's time in s; a day is added to what follows midnight."""
    text = row[column] if column < len(row) else ""
    try:
        hours, minutes, seconds, ticks = text.split(":")
        time = 3600.0 * int(hours) + 60.0 * int(minutes) + int(seconds) + float(ticks) / TICKS
    except ValueError:
        reason = f"'{quote(text)}' is not a timecode hours:minutes:seconds:ticks"
        _refuse(path, line, "timecode", reason)
    if not 0.0 <= time < DAY:  # NaN is neither
        _refuse(path, line, "timecode", f"'{quote(text)}' is not a time of day")
    if before and time <= before[-1] - DAY / 2:
        time += DAY
    if before and time <= before[-1]:
        _refuse(path, line, "time_order", f"{quote(text)} is not later than the frame before")
    return time


def _numbers(
    path: Path,
    line: int,
    row: list[str],
    columns: Mapping[str, int],
    bounds: tuple[float, float],
    noun: str,
) -> list[float]:
    """Return the fields of a frame, all within ``bounds``, where ``noun`` says what they are."""
    numbers = []
    for name, column in columns.items():
        text = row[column] if column < len(row) else ""
        try:
            number = float(text)
        except ValueError:
            _refuse(path, line, "value", f"{name} is '{quote(text)}', not a number")
        if not bounds[0] <= number <= bounds[1]:
            _refuse(path, line, "value", f"{name} is {quote(text)}, which is no {noun}")
        numbers.append(number)
    return numbers


def _rotations(angles: Floats | None, count: int) -> Floats:
    """Return rotation vectors (f, 3) of yaw, pitch and roll (f, 3); zero for None."""
    if angles is None:
        return np.zeros((count, 3))
    yaw, pitch, roll = angles.T
    turns = Rotation.from_euler("ZYX", np.column_stack([-roll, -yaw, pitch]))
    return np.asarray(turns.as_rotvec())


def head_turn(angles: Floats) -> Floats:
    """Return the rotation vector (3,) of a head's yaw, pitch and roll in radians."""
    return np.asarray(_rotations(angles[None], 1)[0])


def _refuse(path: Path, line: int, code: str, what: str) -> NoReturn:
    raise file_error(f"live_link.{code}", path.name, what, line=line)
