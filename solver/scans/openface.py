"""Recordings of OpenFace: intensities of action units, head and gaze of every frame, as CSV.

Intensities are absolute, from 0 to 5, and so are the angles: what the face has at rest is taken off
first. Both sides of the face move alike.

OpenFace's axes are its camera's: x to the image's right, y down, z away from it. A head is turned
by R = R_x R_y R_z there, in radians. Half a turn about x makes them ours (x to the subject's left,
y up, z forward), so that a rotation vector (x, y, z) becomes (x, -y, -z). The head's place is not
read: its depth is as good as a guess at the camera's focal length.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from solver.anatomy.action_units import actions_of
from solver.errors import (
    Finding,
    InputError,
    count_words,
    file_error,
    make_warning,
    quote,
    quote_names,
)
from solver.kinds.scene_recording import Recording
from solver.scans.live_link import ARKIT_NAMES, FaceTake
from solver.scans.signals import (
    SIGNALS,
    fill_gaps,
    gap_notice,
    range_notice,
    rest_frame,
    seen_by,
    smoothed,
    with_looks,
)
from solver.surface import Floats, Ints

UNITS = (1, 2, 4, 5, 6, 7, 9, 10, 12, 14, 15, 17, 20, 23, 25, 26, 45)  # that have an intensity
INTENSITIES = tuple(f"AU{number:02d}_r" for number in UNITS)
POSE = ("pose_Rx", "pose_Ry", "pose_Rz")
GAZE = tuple(f"gaze_{eye}_{axis}" for eye in (0, 1) for axis in "xyz")  # unit vectors
READ = ("frame", "face_id", "timestamp", "confidence", "success", *POSE, *GAZE, *INTENSITIES)
FULL = 5.0  # the greatest intensity
TO_OURS = np.array([1.0, -1.0, -1.0])
MOST_HEADER = 2**16  # characters; OpenFace's own have a tenth of them
NO_NUMBER = re.compile(r"[+-]?(nan\(\w*\)|1\.#(ind|qnan|inf)\w*)", re.IGNORECASE)  # of Windows
# Units that are not played by the shapes that FACS has for each alone: x of the shape at full.
SHAPES = {
    "AU 17": {"mouthShrugLower": 1.0},
    "AU 23": {"mouthPress": 1.0},
    "AU 25": {"mouthLowerDown": 0.5, "mouthUpperUp": 0.3},
    "AU 26": {"jawOpen": 0.6},
}


@dataclass(frozen=True)
class OpenFaceOptions:
    """How frames are judged and mended."""

    confidence: float = 0.7  # of the landmarks; below it a frame is not seen
    bridge_s: float = SIGNALS.bridge_s
    most_fps: float = 500.0  # a faster clock counts pictures, not time
    least_step_s: float = 1e-6  # from a frame to the next
    rest_percentile: float = SIGNALS.rest_percentile
    least_range: float = 0.25  # of intensity that is scaled to 1; a smaller one is noise


def is_openface(path: Path) -> bool:
    """Tell by its header whether a file is a recording of OpenFace, whatever its name is."""
    try:
        with path.open(encoding="utf-8-sig", errors="replace") as file:
            names = {name.strip() for name in re.split("[,;]", file.readline(MOST_HEADER))}
    except OSError:
        return False
    return not names.isdisjoint((*INTENSITIES, *POSE))


def read_openface(
    path: Path, entry: Recording, options: OpenFaceOptions = OpenFaceOptions()
) -> FaceTake:
    """Return a recording as weights of ARKit's shapes, as a scene's ``entry`` asks for them.

    Columns may come in any order, others are not read. Frames in which no face was seen are blended
    over, longer gaps are eased to rest; that and all else that was mended is in its ``notices``.

    Raises :class:`InputError`: ``openface.unreadable``, ``openface.columns``, ``openface.value``,
    ``openface.clock``, ``openface.time_order``, ``openface.faces``, ``openface.no_face`` and
    ``openface.neutral``, with ``file``, and ``line`` and ``column`` where it is about one.
    """
    table = _read_table(path).of_face(entry.face)
    times = _times(table, entry.fps, options)
    seen = _seen(table, options)
    _check_angles(table, seen)
    rest = rest_frame(table.file, "openface", seen, entry.neutral)
    weights, notices = _weights(table, seen, rest, entry, options)
    head, eyes = _turns(table, seen, rest, entry.camera_pitch_deg)
    signals = np.hstack([with_looks(weights, eyes), head, eyes.reshape(-1, 6)])
    signals, gaps = fill_gaps(times, signals, seen, options.bridge_s)
    if gaps:
        notices.append(gap_notice(table.file, "openface", gaps, seen, options.bridge_s))
    if entry.smooth_hz:
        signals = smoothed(times, signals, entry.smooth_hz)
    weights, head, turns = np.split(signals, [-9, -6], axis=1)
    eyes = turns.reshape(-1, 2, 3)
    told = gaps, tuple(notices)
    return FaceTake(times, weights, head, eyes, seen, "openface", (), *told)


@dataclass(frozen=True)
class _Table:
    """The columns of ``READ`` that a file has, (f,) each, and the ``lines`` of its frames."""

    file: str
    columns: dict[str, Floats]
    lines: Ints

    def get(self, names: Sequence[str]) -> Floats:
        """Return columns (f, k); zero if one of them is missing."""
        if not self.columns.keys() >= set(names):
            return np.zeros((len(self.lines), len(names)))
        return np.column_stack([self.columns[name] for name in names])

    def error(self, code: str, reason: str, row: int | None = None, **more: Any) -> InputError:
        """Return an error about the file, or one of its rows."""
        where = more if row is None else {"line": int(self.lines[row]), **more}
        return file_error(code, self.file, reason, **where)

    def of_face(self, face: int | None) -> _Table:
        """Return the rows of a face, the only one for None; raises ``openface.faces``."""
        ids = self.columns.get("face_id", np.zeros(len(self.lines)))
        found = np.unique(ids[np.isfinite(ids)]).tolist()
        if face is None and len(found) > 1:
            known = ", ".join(f"{each:g}" for each in found[:20])
            reason = f'it has the faces {known}: choose one with "face"'
            raise self.error("openface.faces", reason, found=quote_names(found))
        if face is None:
            return self
        if face not in found:
            known = ", ".join(f"{each:g}" for each in found[:20])
            reason = f"it has no face {face}, but {known}"
            raise self.error("openface.faces", reason, expected=quote_names(found), found=face)
        columns = {name: values[ids == face] for name, values in self.columns.items()}
        return replace(self, columns=columns, lines=self.lines[ids == face])


def _read_table(path: Path) -> _Table:
    lines: list[int] = []
    numbers: list[list[float]] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            first = file.readline()
            delimiter = ";" if first.count(";") > first.count(",") else ","
            rows = csv.reader(chain([first], file), delimiter=delimiter)
            header = [name.strip() for name in next(rows, [])]
            places = {name: header.index(name) for name in READ if name in header}
            if places.keys().isdisjoint(INTENSITIES):
                reason = "it has no intensities of action units, such as AU12_r: run with -aus"
                raise file_error("openface.columns", path.name, reason, line=1)
            for row in rows:
                if any(field.strip() for field in row):
                    lines.append(rows.line_num)
                    numbers.append(_numbers(path.name, rows.line_num, row, header, places))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        message = f"{path.name} is not a recording of OpenFace, a table of text: {error}"
        raise InputError("openface.unreadable", message, file=path.name) from error
    if not lines:
        raise InputError("openface.unreadable", f"{path.name} has no frames", file=path.name)
    columns = dict(zip(places, np.array(numbers).T, strict=True))
    return _Table(path.name, columns, np.array(lines))


def _numbers(
    file: str, line: int, row: list[str], header: list[str], places: dict[str, int]
) -> list[float]:
    """Return what is read of a row; NaN where it says so."""
    while len(row) > len(header) and not row[-1].strip():
        row.pop()
    if len(row) != len(header):
        column = header[len(row)] if len(row) < len(header) else str(len(header) + 1)
        reason = f"it has {len(row)} fields, the header {len(header)}"
        if len(row) > len(header):
            reason += "; numbers need decimal points, not commas"
        where = {"line": line, "column": quote(column)}
        raise file_error("openface.value", file, reason, **where)
    numbers = []
    for name, place in places.items():
        text = row[place].strip()
        try:
            number = np.nan if NO_NUMBER.fullmatch(text) else float(text)
        except ValueError:
            number = np.inf
        if np.isinf(number):
            has_comma = re.fullmatch(r"[+-]?\d+,\d+", text)
            hint = "; it needs a decimal point, not a comma" if has_comma else ""
            reason = f"{name} is '{quote(text)}', not a number{hint}"
            raise file_error("openface.value", file, reason, line=line, column=name)
        numbers.append(number)
    return numbers


def _times(table: _Table, fps: float | None, options: OpenFaceOptions) -> Floats:
    """Return the frames' times (f,) in s after the first one; by ``fps`` if it is given."""
    count = len(table.lines)
    name = "timestamp" if fps is None else "frame"
    if name in table.columns:
        clock = table.columns[name]
        bad = np.flatnonzero(~np.isfinite(clock))
        if len(bad):
            raise table.error("openface.value", f"{name} is not a number", int(bad[0]), column=name)
    elif fps is None:
        reason = 'it has no column "timestamp": give the frames a second as "fps"'
        raise table.error("openface.clock", reason)
    else:
        clock = np.arange(count, dtype=np.float64)
    if fps is not None:
        clock = (np.arange(count) if (clock == clock[0]).all() else clock) / fps
    steps = np.diff(clock)
    if fps is None and count > 1:
        forward = steps[steps > 0.0]
        rate = 1.0 / float(np.median(forward)) if len(forward) else np.inf
        if rate > options.most_fps:
            told = f"{rate:.0f} frames a second" if len(forward) else "all frames at one time"
            reason = f'its timestamps make {told}, so they count pictures: give the rate as "fps"'
            raise table.error("openface.clock", reason, found=rate if len(forward) else None)
    late = np.flatnonzero(steps < options.least_step_s)
    if len(late):
        row = int(late[0]) + 1
        reason = f"{name} {table.columns[name][row]:g} is not later than the frame before"
        raise table.error("openface.time_order", reason, row, column=name)
    return np.asarray(clock - clock[0])


def _seen(table: _Table, options: OpenFaceOptions) -> np.ndarray:
    """Return whether a face was seen in each frame (f,); raises ``openface.no_face``."""
    signals = [table.columns[name] for name in table.columns.keys() & {*POSE, *GAZE, *INTENSITIES}]
    seen = np.asarray(np.isfinite(signals).all(axis=0))
    for name, least in (("success", 0.5), ("confidence", options.confidence)):
        if name in table.columns:
            seen &= table.columns[name] >= least
    if not seen.any():
        reason = f"no face is seen in any of its {len(seen)} frames"
        raise table.error("openface.no_face", reason)
    return seen


def _check_angles(table: _Table, seen: np.ndarray) -> None:
    for name in table.columns.keys() & set(POSE):
        bad = np.flatnonzero(seen & ~(np.abs(table.columns[name]) <= 2.0 * np.pi))
        if len(bad):
            row = int(bad[0])
            reason = f"{name} is {table.columns[name][row]:g}, which is no angle in radians"
            raise table.error("openface.value", reason, row, column=name)


def _weights(
    table: _Table, seen: np.ndarray, rest: int | None, entry: Recording, options: OpenFaceOptions
) -> tuple[Floats, list[Finding]]:
    """Return weights (f, 52) of ARKit's shapes, of use where a face is seen, and notices."""
    notices = []
    named = {"file": table.file}
    none = np.zeros(len(seen))
    given = np.column_stack([table.columns.get(name, none) for name in INTENSITIES])
    given[~seen] = 0.0
    scale = FULL if entry.au_scale is None else entry.au_scale
    if entry.au_scale is None and 0.0 < given.max() <= 1.0:
        reason = "no intensity is above 1: the take is weak, or was divided by 5; they are played"
        words = f'{table.file}: {reason} as 0 to 5, set "au_scale" to 1 if they were divided'
        notices.append(make_warning("openface.scale", words, named))
    beyond = int(((given < 0.0) | (given > scale)).sum())
    if beyond:
        which = count_words(beyond, "intensity was", "intensities were")
        words = f"{table.file}: {which} not within 0 and {scale:g}, and were clipped"
        notices.append(make_warning("openface.clipped", words, {**named, "count": beyond}))
    given = given.clip(0.0, scale)
    if rest is None:
        neutral = np.percentile(given[seen], options.rest_percentile, axis=0)
    else:
        neutral = given[rest]
    above = np.maximum(given - neutral, 0.0)
    if entry.gain == "range":
        least = options.least_range * scale / FULL
        above /= np.maximum(above[seen].max(axis=0), least)
        notices.append(range_notice(table.file, "openface", "action unit"))
    else:
        above *= entry.gain / scale
    return above @ shapes_of_units(), notices


@cache
def shapes_of_units() -> Floats:
    """Return the weight of each of ARKit's shapes at a unit's full intensity (17, 52)."""
    table = np.zeros((len(UNITS), len(ARKIT_NAMES)))
    for column, name in enumerate(ARKIT_NAMES):
        alone = {action.unit.code for action in actions_of(name)}
        shape = name.removesuffix("Left").removesuffix("Right")
        for row, number in enumerate(UNITS):
            code = f"AU {number}"
            of_facs = {shape: 1.0} if alone == {code} else {}
            table[row, column] = SHAPES.get(code, of_facs).get(shape, 0.0)
    return table


def _turns(
    table: _Table, seen: np.ndarray, rest: int | None, camera_pitch_deg: float | None
) -> tuple[Floats, Floats]:
    """Return rotation vectors of the head (f, 3) and the eyes in it (f, 2, 3), from rest on.

    The head's are in the world where it is known how the camera looks. Both eyes look where their
    mean gaze goes, as each by itself is poor; none of them rolls.
    """
    angles = np.where(seen[:, None], table.get(POSE), 0.0)
    turns = Rotation.from_euler("XYZ", angles)
    still = turns[seen].mean() if rest is None else turns[rest]
    head = (still.inv() * turns).as_rotvec() * TO_OURS
    if camera_pitch_deg is not None:
        head = seen_by(turns.as_rotvec() * TO_OURS, camera_pitch_deg)
    if not table.columns.keys() >= set(GAZE):
        return head, np.zeros((len(seen), 2, 3))
    both = np.where(seen[:, None], table.get(GAZE), 0.0).reshape(-1, 2, 3)
    x, y, z = (turns.inv().apply(both.mean(axis=1)) * TO_OURS).T
    looks = np.column_stack([np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))])
    looks -= np.median(looks[seen], axis=0) if rest is None else looks[rest]
    eyes = Rotation.from_euler("YX", looks).as_rotvec()
    return head, np.stack([eyes, eyes], axis=1)
