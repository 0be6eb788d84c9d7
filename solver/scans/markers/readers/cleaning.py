"""Settling what a file leaves open: whose labels, which tracks have none, and which unit."""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from solver.errors import MOST_NAMES, Finding, InputError, Severity, quote, quote_names
from solver.kinds.marker_set import LONGEST_LABEL
from solver.registration.units import COMMON, UNITS, ScanUnit, likely_unit
from solver.scans.markers.readers.raw_take import RawTake, TakeOptions, make_finding
from solver.surface import Floats

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
        texts, subject = [":".join(filter(None, parts[at])) for at in labelled], ""
    else:
        texts, subject = [parts[at][1] for at in labelled], ", ".join(filter(None, subjects))
    labels, more = _number_labels(file, texts)
    names_of_others = [parts[at][1] or f"#{at + 1}" for at in others]
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
    taken, proposals = set(texts), {}
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


# Units, and points that are none.


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
