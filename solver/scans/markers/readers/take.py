"""A take: labelled points over time, as an optical system or a tracker of video leaves them."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from solver.errors import Finding, InputError, Severity, quote
from solver.registration.units import AXES
from solver.scans.markers.readers.c3d import KEY, MOST_EVENTS, read_c3d
from solver.scans.markers.readers.raw_take import (
    ADVICE,
    MOST_FRAME,
    TAKE_OPTIONS,
    RawTake,
    TakeEvent,
    TakeOptions,
    check_room,
    check_seen,
    choose_rate,
    drop_far,
    read_labels,
    settle_unit,
    tidy_label,
    unreadable_error,
)
from solver.scans.markers.readers.table import read_motive, read_trc
from solver.storage import Archive, Arrays, read_arrays
from solver.surface import Floats

FORMAT = 1  # of takes as NPZ
LONGEST_FINDING = 8000  # characters of JSON
BEGIN = 4096  # bytes by which the reader of a file is chosen


@dataclass(frozen=True)
class Take:
    """Positions of labelled points in the axes of the file, in mm, NaN where one is missing.

    k labels, f frames, u tracks that have no label and may be any marker.
    """

    file: str
    labels: tuple[str, ...]  # (k,), without blanks and without a subject's prefix
    positions: Floats  # (f, k, 3)
    rate: float  # frames a second; NaN where the file has none
    first: int = 1  # number of the first frame
    unit_mm: float = 1.0  # mm a unit of the file: positions are multiplied by it
    sigma: Floats | None = None  # (f, k, 3) standard deviations in mm, where the file has them
    residual: Floats | None = None  # (f, k) of the system's triangulation in mm, NaN if unknown
    unlabelled: Floats = field(default_factory=lambda: np.zeros((0, 0, 3)))  # (f, u, 3)
    unlabelled_names: tuple[str, ...] = ()  # (u,)
    subject: str = ""  # the prefix that all labels had
    up: str | None = None  # the axis that is up by the file, as "y" or "-z"
    events: tuple[TakeEvent, ...] = ()
    findings: tuple[Finding, ...] = ()  # what reading it found

    def __post_init__(self) -> None:
        if not self.unlabelled_names:
            object.__setattr__(self, "unlabelled", np.zeros((len(self.positions), 0, 3)))

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def numbers(self) -> range:
        """Return the numbers of the frames as the file counts them.

        Options, findings and sequences have these; a number's place in the range is its row here.
        """
        return range(self.first, self.first + len(self))

    @property
    def missing(self) -> np.ndarray:
        """Return which points of which frames are missing (f, k)."""
        return np.asarray(np.isnan(self.positions[..., 0]))

    @property
    def seconds(self) -> float:
        """Return how long the take is; NaN where the rate is not known."""
        return len(self.positions) / self.rate

    def pick(self, columns: Sequence[int]) -> Take:
        """Return the take with some of its labels; one may come twice."""
        return replace(
            self,
            labels=tuple(self.labels[column] for column in columns),
            positions=self.positions[:, columns],
            sigma=None if self.sigma is None else self.sigma[:, columns],
            residual=None if self.residual is None else self.residual[:, columns],
        )

    def save(self, path: Path, *, packed: bool = True) -> None:
        """Write the take as NPZ, ``packed`` or quickly."""
        header = {
            "format": FORMAT,
            "file": self.file,
            "labels": list(self.labels),
            "rate": None if np.isnan(self.rate) else self.rate,
            "first": self.first,
            "unit_mm": self.unit_mm,
            "unlabelled_names": list(self.unlabelled_names),
            "subject": self.subject,
            "up": self.up,
            "events": [asdict(event) for event in self.events],
            "findings": [finding.to_dict() for finding in self.findings],
        }
        arrays = {"positions": self.positions, "unlabelled": self.unlabelled}
        further = {"sigma": self.sigma, "residual": self.residual}
        arrays |= {name: values for name, values in further.items() if values is not None}
        Archive(header, arrays).write(path, packed=packed)

    @classmethod
    def load(cls, path: Path) -> Take:
        """Read a take that :meth:`save` wrote, checked as those of other programs are.

        Findings of reading it that are none of this release's are left out. Raises
        :class:`InputError` as :func:`read_take`.
        """
        archive = Archive.read(path, "markers", "a take", FORMAT)
        header = archive.header
        arrays = archive.arrays
        try:
            take = cls(
                quote(header["file"]),
                tuple(map(str, header["labels"])),
                arrays["positions"],
                float("nan") if header["rate"] is None else float(header["rate"]),
                int(header["first"]),
                float(header["unit_mm"]),
                arrays.get("sigma"),
                arrays.get("residual"),
                arrays["unlabelled"],
                tuple(map(str, header["unlabelled_names"])),
                quote(header["subject"]),
                header["up"] if header["up"] in (*AXES, None) else None,
                tuple(
                    TakeEvent(quote(event["name"]), float(event["time"]))
                    for event in header["events"][:MOST_EVENTS]
                ),
                tuple(filter(None, map(_known_finding, header["findings"]))),
            )
        except (AttributeError, LookupError, OverflowError, TypeError, ValueError) as error:
            raise unreadable_error(path.name, f"it is not a take: {error}") from error
        shape = take.positions.shape
        others = take.unlabelled.shape
        is_right = shape == (*shape[:1], len(take.labels), 3)
        is_right &= others == (*shape[:1], len(take.unlabelled_names), 3)
        is_right &= take.sigma is None or take.sigma.shape == shape
        is_right &= take.residual is None or take.residual.shape == shape[:2]
        if not is_right or any(array.dtype != float for array in arrays.values()):
            raise unreadable_error(path.name, "its arrays do not fit its labels")
        _check_bounds(path.name, take, TAKE_OPTIONS)
        return take


def _known_finding(values: Any) -> Finding | None:
    """Return what reading a take once found, as it may stand in a report; None of what may not."""
    try:
        code = values["code"]
        severity = values["severity"]
        text = json.dumps(values, allow_nan=False)
        if code not in ADVICE or severity not in get_args(Severity) or len(text) > LONGEST_FINDING:
            return None
        found = Finding.from_dict(values)
        return replace(found, message=str(found.message), advice=ADVICE[code])
    except (LookupError, RecursionError, TypeError, ValueError):
        return None


def _check_bounds(file: str, take: Take, options: TakeOptions) -> None:
    """Refuse a take of labels and numbers that :func:`read_take` gives none of."""
    names = (*take.labels, *take.unlabelled_names)
    check_room(file, len(take), len(names), options)
    least, most = options.rates
    if not (np.isnan(take.rate) or least <= take.rate <= most):
        raise unreadable_error(file, f"its rate is {take.rate:g}")
    least, most = options.units_mm
    if not least <= take.unit_mm <= most:
        raise unreadable_error(file, f"its unit is {take.unit_mm:g} mm")
    for name in names:
        if not name or tidy_label(name) != name:
            raise unreadable_error(file, f"'{quote(name)}' is no label as readers leave them")
    if len(set(take.labels)) < len(take.labels):
        twice = next(name for name, count in Counter(take.labels).items() if count > 1)
        raise unreadable_error(file, f"it has the label '{quote(twice)}' twice")
    if not np.isfinite([event.time for event in take.events]).all():
        raise unreadable_error(file, "it has an event at no time")
    for points in (take.positions, take.unlabelled):
        points[np.isnan(points).any(axis=-1)] = np.nan
    if not any(np.isfinite(each).any() for each in (take.positions, take.unlabelled)):
        raise InputError("markers.none", f"{file} has no point that is ever seen", file=file)
    seen = np.isfinite(take.positions[..., 0])
    if take.sigma is not None:
        sigma = take.sigma[seen]
        least = options.least_sigma * take.unit_mm
        if not ((sigma >= least) & (sigma < np.inf)).all():
            raise unreadable_error(file, f"it has a sigma that is not above {least:g} mm")
    if not abs(take.first) <= MOST_FRAME:
        raise unreadable_error(file, "'first' is not the number of a frame")
    if any(
        (np.abs(each) > options.farthest_mm).any() for each in (take.positions, take.unlabelled)
    ):
        raise unreadable_error(file, "it has points where no studio is")


def read_take(path: Path, options: TakeOptions = TAKE_OPTIONS) -> Take:
    """Return the take of a file: C3D, TRC, CSV of Motive, NPZ of landmarks or of :meth:`Take.save`.

    The reader is chosen by what the file holds and not by its suffix. Labels lose blanks and the
    subject's prefix, tracks without a label are kept apart; what the file left open, and how it was
    settled, is in ``findings``. The axes stay the file's.

    Raises :class:`InputError` with ``file``: ``markers.unreadable`` (with ``line`` where it is
    text), ``markers.truncated``, ``markers.too_large``, ``markers.none`` or ``markers.format``.
    """
    file = path.name
    try:
        size = path.stat().st_size
        if size > options.most_bytes:
            message = f"{file} has {size} bytes; at most {options.most_bytes} can be read"
            raise InputError("markers.too_large", message, file=file, found=size)
        with path.open("rb") as stream:
            begin = stream.read(BEGIN)
        if begin.startswith(b"PK"):
            return _read_npz(path, options)
        read = _reader(file, begin)
        return _settle(file, read(path, options), options)
    except OSError as error:
        raise unreadable_error(file, f"it cannot be read: {error.strerror}") from error


def _reader(file: str, begin: bytes) -> Callable[[Path, TakeOptions], RawTake]:
    text = begin.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if begin[1:2] == bytes([KEY]) and not text.startswith(b"pathfiletype"):
        return read_c3d
    if text.startswith(b"pathfiletype"):
        return read_trc
    if text.startswith(b"format version"):
        return read_motive
    if begin.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise unreadable_error(file, "it is text in UTF-16; save it as UTF-8")
    raise unreadable_error(file, "it is not C3D, TRC, a CSV of Motive, or NPZ")


def _read_npz(path: Path, options: TakeOptions) -> Take:
    try:
        arrays = read_arrays(path)
    except ValueError as error:
        raise unreadable_error(path.name, f"it is not a whole NPZ: {error}") from error
    if "header" in arrays:
        return Take.load(path)
    return _settle(path.name, _arrange_landmarks(path.name, arrays, options), options)


def _settle(file: str, raw: RawTake, options: TakeOptions) -> Take:
    """Return the take of what a file has: labels tidied, in mm."""
    check_seen(file, raw)
    count = raw.points.shape[1]
    read = read_labels(file, raw.names, count)
    unit, units = settle_unit(file, raw, read.labelled or read.unlabelled, options)
    for lengths in (raw.points, raw.sigma, raw.residual):
        if lengths is not None:
            lengths *= unit
    far = drop_far(file, raw, options.farthest_mm)
    check_seen(file, raw)
    return Take(
        file,
        read.labels,
        _pick(raw.points, read.labelled),
        raw.rate,
        raw.first,
        unit,
        None if raw.sigma is None else _pick(raw.sigma, read.labelled),
        None if raw.residual is None else _pick(raw.residual, read.labelled),
        _pick(raw.points, read.unlabelled),
        read.unlabelled_names,
        read.subject,
        raw.up,
        raw.events,
        (*raw.findings, *read.findings, *units, *far),
    )


def _pick(values: Floats, columns: list[int]) -> Floats:
    """Return the columns of ``values`` (f, n, ...); those of all are not copied."""
    return values if len(columns) == values.shape[1] else values[:, columns]


# Landmarks over time from NPZ, as any tracker of video can write them: ``names`` (k,) and
# ``points`` (f, k, 3), NaN where one is not seen; ``sigma``, standard deviations a coordinate, of
# any shape that spreads to that of the points, as video sees depth far worse; and ``rate`` (Hz),
# ``first`` (a frame's number) and ``unit`` (a name, or mm) if they are known.


def _arrange_landmarks(file: str, arrays: Arrays, options: TakeOptions) -> RawTake:
    """Return landmarks as a take.

    Raises :class:`InputError`: ``markers.unreadable``, ``markers.none`` or ``markers.too_large``.
    """
    missing = [name for name in ("names", "points") if name not in arrays]
    if missing:
        raise unreadable_error(file, f"it has no array '{missing[0]}'")
    names = arrays["names"]
    points = arrays["points"]
    is_right = names.dtype.kind == "U" and names.ndim == 1 and points.dtype.kind in "fiu"
    if not is_right or points.ndim != 3 or points.shape[1:] != (len(names), 3):
        shapes = f"names {quote(names.shape)} and points {quote(points.shape)}"
        raise unreadable_error(
            file, f"it has {shapes}; names (k,) and points (f, k, 3) are expected"
        )
    check_room(file, len(points), len(names), options)
    points = points.astype(float)
    points[~points.any(axis=-1)] = np.nan  # exactly 0, 0, 0
    labels = names.tolist()
    sigma = _sigma(file, arrays["sigma"], points, labels, options) if "sigma" in arrays else None
    number = _number(file, arrays, "rate")
    rate, findings = choose_rate(file, [] if number is None else [("rate", number)], options)
    first = _number(file, arrays, "first")
    if first is not None and not abs(first) <= MOST_FRAME:
        raise unreadable_error(file, f"'first' is {first:g}, not the number of a frame")
    unit = _unit(file, arrays, options)
    number = 1 if first is None else int(first)
    return RawTake(labels, points, rate, number, unit, sigma=sigma, findings=findings)


def _sigma(
    file: str, given: np.ndarray, points: Floats, labels: list[str], options: TakeOptions
) -> Floats:
    """Return sigma (f, k, 3); a point of which it is not finite becomes missing."""
    by_point = given[..., None] if given.shape in (points.shape[:2], points.shape[1:2]) else given
    try:
        spread = np.broadcast_to(by_point, points.shape)
    except ValueError:
        reason = f"sigma {quote(given.shape)} does not spread to points {quote(points.shape)}"
        raise unreadable_error(file, reason) from None
    if spread.dtype.kind not in "fiu":
        raise unreadable_error(file, f"sigma holds {quote(spread.dtype)}, not numbers")
    sigma = spread.astype(float)
    points[~np.isfinite(sigma).all(axis=-1)] = np.nan
    is_bad = (~(sigma >= options.least_sigma)).any(axis=-1) & np.isfinite(points).all(axis=-1)
    if is_bad.any():
        frame, track = map(int, np.argwhere(is_bad)[0])
        label = quote(labels[track])
        reason = f"sigma of {label} in frame {frame} is not above {options.least_sigma:g}"
        raise unreadable_error(file, reason, label=label, frame=frame)
    return sigma


def _number(file: str, arrays: Arrays, name: str) -> float | None:
    value = arrays.get(name)
    if value is None:
        return None
    if value.size != 1 or value.dtype.kind not in "fiu":
        raise unreadable_error(file, f"'{name}' is not a number")
    return float(value.reshape(-1)[0])


def _unit(file: str, arrays: Arrays, options: TakeOptions) -> str | float | None:
    value = arrays.get("unit")
    if value is None or value.dtype.kind != "U":
        mm = _number(file, arrays, "unit")
        least, most = options.units_mm
        if mm is not None and not least <= mm <= most:
            raise unreadable_error(file, f"'unit' is {mm:g}, not {least:g} to {most:g} mm")
        return mm
    return str(value.reshape(-1)[0]) if value.size == 1 else None
