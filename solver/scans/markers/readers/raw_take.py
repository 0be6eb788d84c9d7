"""Tracks as a file has them, how a file is refused, and how labels and units are settled."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from solver.errors import (
    MOST_NAMES,
    Finding,
    InputError,
    Severity,
    advise,
    file_error,
    quote,
    quote_names,
)
from solver.kinds.kind import MM_A_UNIT
from solver.kinds.marker_set import LONGEST_LABEL
from solver.registration.units import COMMON, UNITS, ScanUnit, likely_unit
from solver.scans import read_advice
from solver.surface import Floats

ADVICE = read_advice("take")
make_finding = partial(advise, ADVICE)
unreadable_error = partial(file_error, "markers.unreadable")


MOST_FRAME = 10**9  # a frame's number


@dataclass(frozen=True)
class TakeOptions:
    """Bounds of what is read, and sizes and rates that are likely."""

    most_bytes: int = 2 << 30  # of a file
    most_values: int = 40_000_000  # coordinates of all tracks: 320 MB
    most_tracks: int = 10_000
    longest_line: int = 4 << 20  # characters of a line of text
    farthest_mm: float = 1e5  # a point beyond it is no place in a studio
    face_mm: tuple[float, float] = (30.0, 120.0)  # markers of a face spread as far, rms
    seen_mm: tuple[float, float] = (12.0, 1500.0)  # a child's few to a body's many
    rates: tuple[float, float] = (0.01, 10_000.0)  # Hz
    units_mm: tuple[float, float] = MM_A_UNIT  # of a file that says it as a number
    least_sigma: float = 1e-9  # standard deviation in units of the file: no point is surer
    rate_slack: float = 0.005  # by which two rates in a file may differ
    most_gaps: float = 1.0  # frames that are left out, for each that is there


TAKE_OPTIONS = TakeOptions()


@dataclass(frozen=True)
class TakeEvent:
    """Something that the file marks in time."""

    name: str
    time: float  # s, on the clock of the file


@dataclass
class RawTake:
    """n tracks of f frames, in the units of the file."""

    names: Sequence[str]  # (n,) as the file has them; shorter where tracks have no name
    points: Floats  # (f, n, 3), NaN where the file leaves a point out or marks it so
    rate: float  # Hz; NaN where the file has none
    first: int = 1  # number of the first frame
    unit: str | float | None = None  # its name as the file has it, or mm
    residual: Floats | None = None  # (f, n) in the file's units, NaN if unknown
    sigma: Floats | None = None  # (f, n, 3) in the file's units
    up: str | None = None  # the axis that is up by the file
    events: tuple[TakeEvent, ...] = ()
    findings: list[Finding] = field(default_factory=list)


def truncated_error(file: str, reason: str, **context: Any) -> InputError:
    """Return the error of a file that ends too early."""
    message = f"{file} ends too early: {reason}"
    return InputError("markers.truncated", message, file=file, **context)


def decode(text: bytes) -> str:
    """Return text as the file means it: UTF-8, or what Western programs wrote before it."""
    try:
        return text.decode("utf-8").strip("\0 ")
    except UnicodeDecodeError:
        return text.decode("latin-1").strip("\0 ")


def check_room(file: str, frames: int, tracks: int, options: TakeOptions) -> None:
    """Raise :class:`InputError` (``markers.none``, ``markers.too_large``) before room is made."""
    if not frames or not tracks:
        what = "frames" if tracks else "points"
        raise InputError("markers.none", f"{file} has no {what}", file=file)
    values = 3 * frames * tracks
    if values > options.most_values or tracks > options.most_tracks:
        message = (
            f"{file} has {frames} frames of {tracks} tracks; at most {options.most_tracks} tracks "
            f"and {options.most_values // 3} points can be read"
        )
        raise InputError("markers.too_large", message, file=file, frames=frames, tracks=tracks)


def spread_frames(
    file: str, numbers: Sequence[int], points: Floats, options: TakeOptions
) -> tuple[Floats, list[Finding]]:
    """Return points (f, n, 3) with NaN for the frames that ``numbers`` (increasing) leave out."""
    missing = numbers[-1] - numbers[0] + 1 - len(numbers)
    if not missing:
        return points, []
    if missing > options.most_gaps * len(numbers):
        step = int(np.argmax(np.diff(np.array(numbers, np.int64))))
        before = numbers[step]
        after = numbers[step + 1]
        raise unreadable_error(file, f"frame {after} follows frame {before}", frame=after)
    check_room(file, len(numbers) + missing, points.shape[1], options)
    spread = np.full((len(numbers) + missing, *points.shape[1:]), np.nan)
    spread[np.array(numbers, np.int64) - numbers[0]] = points
    message = f"{file} leaves out {missing} of {len(spread)} frames."
    return spread, [make_finding("markers.frames", "warning", message, file=file, frames=missing)]


def choose_rate(
    file: str, sources: Iterable[tuple[str, float]], options: TakeOptions
) -> tuple[float, list[Finding]]:
    """Return the rate in Hz by the first of the sources that has one; NaN if none has.

    ``sources`` are rates by the names of their places in the file; a finding where they differ.
    """
    rates = list(sources)
    least, most = options.rates
    usable = [(place, rate) for place, rate in rates if least <= rate <= most]
    if not usable:
        words = ", ".join(f"{place} {rate:g}" for place, rate in rates) or "nothing"
        message = f"{file} has no usable frame rate ({words})."
        return float("nan"), [make_finding("markers.rate", "warning", message, file=file)]
    place, rate = usable[0]
    others = [each for each in usable[1:] if abs(each[1] / rate - 1.0) > options.rate_slack]
    if len(usable) == len(rates) and not others:
        return rate, []
    words = ", ".join(f"{where} {value:g} Hz" for where, value in rates)
    message = f"{file} says different rates: {words}; it is read at {rate:g} Hz, by {place}."
    return rate, [make_finding("markers.rate", "warning", message, file=file, found=rate)]


# Settling what a file leaves open: whose labels, which tracks have none, and which unit.


# How capture programs call a track that nobody has labelled: *12, U_3, Unlabeled 1004, ?7.
UNLABELLED = re.compile(r"[*?]+\d*|u_\*?\d+|(unlabell?ed|uname|noname|unnamed)\W*_?\d*", re.I)
NAMES = {  # of units, in the singular, as Americans write them -> mm
    "mm": 1.0,
    "millimeter": 1.0,
    "cm": 10.0,
    "centimeter": 10.0,
    "m": 1000.0,
    "meter": 1000.0,
    "in": 25.4,
    "inch": 25.4,
    "ft": 304.8,
    "feet": 304.8,
}
LONGEST_NUMBER = 6  # characters of a number behind labels that are alike
LOOKED_AT = 200  # frames of which the size is taken


@dataclass(frozen=True)
class Labels:
    """Columns of a file that are labelled tracks, and those that are not."""

    labels: tuple[str, ...]
    labelled: list[int]  # columns
    unlabelled_names: tuple[str, ...]
    unlabelled: list[int]  # columns
    subject: str
    findings: list[Finding]


def read_labels(file: str, names: Sequence[str], count: int) -> Labels:
    """Return labels of ``count`` tracks without blanks and subjects, and those that have none.

    A label that stands there twice gets a number. Where two subjects have the same labels all keep
    their subject's name, as ``Jane:LBRO1``.
    """
    plain = [tidy_label(name) for name in names[:count]] + [""] * (count - len(names))
    parts = [tuple(map(str.strip, name.rpartition(":")[::2])) for name in plain]
    labelled = [
        at for at, (_, label) in enumerate(parts) if label and not UNLABELLED.fullmatch(label)
    ]
    others = sorted(set(range(count)) - set(labelled))
    unnamed = [at for at in others if not parts[at][1]]
    findings = []
    if unnamed:
        message = f"{file}: {len(unnamed)} of {count} tracks have no label; they count as any."
        findings.append(
            make_finding("markers.labels", "warning", message, file=file, tracks=unnamed[:20])
        )
    elif not labelled:
        message = f"{file} has {count} tracks and no label; binding goes by their places."
        findings.append(make_finding("markers.labels", "warning", message, file=file))
    pairs = {parts[at] for at in labelled}
    subjects = list(dict.fromkeys(parts[at][0] for at in labelled))
    if len(pairs) > len({label for _, label in pairs}):
        shown = quote_names([each or "no subject" for each in subjects])
        message = f"{file} has the same labels for {', '.join(shown)}: more than one face."
        findings.append(
            make_finding("markers.two_faces", "warning", message, file=file, subjects=shown)
        )
        texts = [":".join(filter(None, parts[at])) for at in labelled]
        subject = ""
    else:
        texts = [parts[at][1] for at in labelled]
        subject = ", ".join(filter(None, subjects))
    labels, more = _number_labels(file, texts)
    # none is alike another: they may be all the labels that a take has
    names_of_others, _ = _number_labels(file, [parts[at][1] or f"#{at + 1}" for at in others])
    return Labels(
        tuple(labels),
        labelled,
        tuple(names_of_others),
        others,
        quote(subject),
        findings + more + _find_foreign(file, labels),
    )


def tidy_label(name: str) -> str:
    """Return a name in one form of Unicode, with single blanks and nothing that does not print."""
    text = " ".join(unicodedata.normalize("NFC", name[: 4 * LONGEST_LABEL]).split())
    return "".join(each for each in text if each.isprintable())[:LONGEST_LABEL].strip(" :")


def _number_labels(file: str, texts: Sequence[str]) -> tuple[list[str], list[Finding]]:
    """Return labels of which no two are alike; those that are get a number."""
    taken = set(texts)
    proposals = {}
    seen: Counter[str] = Counter()
    labels = []
    for text in texts:
        seen[text] += 1
        label = text
        while label != text or seen[text] > 1:
            label = f"{text[: LONGEST_LABEL - LONGEST_NUMBER]}_{seen[text]}"
            if label not in taken:
                break
            seen[text] += 1
        if label != text:
            proposals[label] = text
            taken.add(label)
        labels.append(label)
    if not proposals:
        return labels, []
    twice = quote_names(list(dict.fromkeys(proposals.values())))
    message = f"{file} has labels more than once: {', '.join(twice)}; the others get a number."
    shown = dict(list(proposals.items())[:MOST_NAMES])  # labels are short and printable by now
    return labels, [
        make_finding("markers.labels", "warning", message, file=file, labels=twice, proposals=shown)
    ]


def _find_foreign(file: str, labels: Sequence[str]) -> list[Finding]:
    """Find labels that not every program can read, with ones that it can."""
    foreign = [label for label in labels if not label.isascii()]
    if not foreign:
        return []
    shown = {
        each: unicodedata.normalize("NFKD", each).encode("ascii", "ignore").decode()
        for each in foreign[:MOST_NAMES]
    }
    message = f"{file} has labels beyond ASCII: {', '.join(quote_names(foreign))}."
    return [
        make_finding(
            "markers.labels", "info", message, file=file, labels=list(shown), proposals=shown
        )
    ]


def settle_unit(
    file: str, raw: RawTake, columns: Sequence[int], options: TakeOptions
) -> tuple[float, list[Finding]]:
    """Return mm a unit: the file's own, unless the tracks at ``columns`` are on no person then.

    Without a unit, or with one that cannot be, a file is read in the one in which its points spread
    as markers of a face do. An ``error`` is one that no unit fits.
    """
    unit = raw.unit
    named = _mm_of(unit) if isinstance(unit, str) else unit
    spread = _spread(raw.points, columns)
    if named and (np.isnan(spread) or likely_unit(spread, options.seen_mm, [named])):
        return named, []
    words = f"says '{quote(unit)}'" if unit else "does not say its unit"
    for bounds in (options.face_mm, options.seen_mm):
        mm = likely_unit(spread, bounds, UNITS.values())
        if mm is None:
            continue
        name = ScanUnit(mm, "found").name
        size = f"in which points spread {spread * mm:.0f} mm about their middle"
        is_plain = not unit and bounds == options.face_mm and name in COMMON
        figures = {"file": file, "unit": name, "spread_mm": round(spread * mm, 1)}
        severity: Severity = "info" if is_plain else "warning"
        message = f"{file} {words}; it is read in {name}, {size}."
        return mm, [make_finding("markers.unit", severity, message, **figures)]
    if np.isnan(spread):
        message = (
            f"{file} {words}, and too few points are seen at once to guess it: it is read in mm."
        )
        return 1.0, [make_finding("markers.unit", "warning", message, file=file)]
    message = f"{file} {words}, and in no unit its points, {spread:.3g} apart, are on a person."
    return named or 1.0, [make_finding("markers.unit", "error", message, file=file, spread=spread)]


def drop_far(file: str, raw: RawTake, most: float) -> list[Finding]:
    """Make points NaN that are infinite or farther off than ``most``; a finding if any are."""
    points = raw.points
    is_far = (points > most).any(axis=-1) | (points < -most).any(axis=-1)
    points[is_far | np.isnan(points).any(axis=-1)] = np.nan
    count = int(is_far.sum())
    if not count:
        return []
    frame, track = map(int, np.argwhere(is_far)[0])
    label = quote(raw.names[track] if track < len(raw.names) else f"#{track + 1}")
    number = raw.first + frame
    message = (
        f"{file} has {count} points where no studio is, the first, {label}, in frame {number}."
    )
    return [
        make_finding(
            "markers.far", "warning", message, file=file, label=label, frame=number, count=count
        )
    ]


def check_seen(file: str, raw: RawTake) -> None:
    """Raise :class:`InputError` (``markers.none``) if no point is ever seen."""
    if not np.isfinite(raw.points[..., 0]).any():
        message = f"{file} has {raw.points.shape[1]} tracks, and none of them is ever seen"
        raise InputError("markers.none", message, file=file)


def _mm_of(name: str) -> float | None:
    word = name.strip().lower().replace("metre", "meter")
    return NAMES.get(word.removesuffix("es") if word == "inches" else word.removesuffix("s"))


def _spread(points: Floats, columns: Sequence[int]) -> float:
    """Return the median distance from the middle of a frame; NaN if none has three points."""
    step = max(1, len(points) // LOOKED_AT)
    spreads = []
    for frame in points[::step]:
        seen = frame[columns]
        seen = seen[np.isfinite(seen).all(axis=1)]
        if len(seen) >= 3:
            spreads.append(np.sqrt(np.median(((seen - np.median(seen, axis=0)) ** 2).sum(axis=1))))
    return float(np.median(spreads)) if spreads else float("nan")
