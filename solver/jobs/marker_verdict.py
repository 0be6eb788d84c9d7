"""The verdict of a fitted take: how near all of its markers are, and which were rejected when.

Figures over the markers that a fit kept look the better the more it rejects. So those over all that
were seen stand beside them, and labels that were often rejected, or many in one frame, are told.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from solver.errors import (
    Finding,
    Severity,
    advise,
    count_words,
    judge_findings,
    quote,
    quote_names,
    worst_first,
)
from solver.jobs.sequences import distance_figures
from solver.scans.markers.readers.names import LOWER, read_names
from solver.scans.markers.signal.faults import runs
from solver.scans.markers.signal.motion import rms_of_seen
from solver.surface import Floats

ADVICE = {
    "markers.rejected": "Look at the label in these frames, and at its place on the face at rest.",
    "markers.rejected_frames": "Look at these frames: the face is not what its markers show there.",
    "markers.rejected_most": "Check the take, its rest and the marker set: one of them is wrong.",
    "markers.far_off": "Check the rest, the marker set, and whose face it is (--actor).",
    "markers.region_off": "Check the rest: with a mouth open in it the jaw follows too little.",
    "markers.label_off": "Look at their places on the face at rest: they may be bound beside them.",
}


@dataclass(frozen=True)
class FitLimits:
    """Beyond these a fitted take has a finding; lengths in mm."""

    rejected: float = 0.05  # of the frames in which a label is seen
    at_once: float = 0.1  # of the markers that are seen in a frame ...
    least_at_once: int = 3  # ... and so many
    most: float = 0.3  # of all points: the fit is bad
    far: float = 3.0  # mean over all points: as many off another person
    off: float = 2.0  # rms of a label, or of a region's labels: they are not followed
    region: float = 2.0  # times as far off as the other markers: a region is not followed
    labels: int = 6  # with a finding of their own; the others are counted
    spans: int = 20  # of frames that are listed


def judge_fit(
    labels: Sequence[str],
    numbers: Sequence[int],
    states: NDArray[np.str_],
    off: Floats,
    notices: Iterable[Finding] = (),
    limits: FitLimits = FitLimits(),
) -> dict[str, Any]:
    """Return figures over all markers, findings and verdict of fitted frames, as JSON values.

    ``states`` (f, k) are what became of each marker, ``off`` (f, k) how far points are from the
    fitted face's markers, also those that were rejected; NaN where none was seen.
    """
    seen = np.isfinite(off)
    rejected = seen & (states == "outlier")
    share = float(rejected.sum() / max(seen.sum(), 1))
    shares = rejected.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)  # of each label
    points = off[seen]
    figures = distance_figures(points) | _farthest(labels, numbers, off)
    findings = [
        *_often_rejected(labels, numbers, rejected, shares, off, limits),
        *_rejected_at_once(labels, numbers, rejected, seen, limits),
        *_regions_off(labels, off, limits),
        *_labels_off(labels, shares, off, limits),
    ]
    if share > limits.most:
        words = f"{share:.0%} of all points were rejected: what is left tells little of the face."
        context = {"found": round(share, 3), "expected": limits.most}
        findings.insert(0, _add("markers.rejected_most", "error", words, **context))
    if len(points) and points.mean() > limits.far:
        words = f"All markers that were seen are {points.mean():.1f} mm off on average."
        context = {"found": figures["mean_mm"], "expected": limits.far}
        findings.insert(0, _add("markers.far_off", "error", words, **context))
    return {
        "verdict": judge_findings([*findings, *notices]),
        "all_markers": {**figures, "rejected": round(share, 4)},
        "findings": [each.to_dict() for each in worst_first(findings)],
    }


def _often_rejected(
    labels: Sequence[str],
    numbers: Sequence[int],
    rejected: NDArray[np.bool_],
    shares: Floats,
    off: Floats,
    limits: FitLimits,
) -> list[Finding]:
    """Return a finding for each label that was often rejected, the worst first."""
    often = [each for each in np.argsort(-shares).tolist() if shares[each] > limits.rejected]
    findings = []
    for label in often[: limits.labels]:
        mine = rejected[:, label]
        spans = _spans(mine, numbers)
        most = float(off[mine, label].max())
        words = (
            f"{quote(labels[label])} was rejected in {shares[label]:.0%} of its frames, up to "
            f"{most:.1f} mm off: {_words(spans)}."
        )
        context = {
            "label": labels[label],
            "frames": spans[: limits.spans],
            "share": round(float(shares[label]), 4),
            "found": round(most, 2),
        }
        findings.append(_add("markers.rejected", "warning", words, **context))
    others = often[limits.labels :]
    if others:
        names = quote_names([labels[each] for each in others])
        which = "label was" if len(others) == 1 else "labels were"
        words = f"{len(others)} more {which} rejected in at most {shares[others[0]]:.0%}."
        findings.append(_add("markers.rejected", "warning", words, labels=names))
    return findings


def _rejected_at_once(
    labels: Sequence[str],
    numbers: Sequence[int],
    rejected: NDArray[np.bool_],
    seen: NDArray[np.bool_],
    limits: FitLimits,
) -> list[Finding]:
    """Return the finding of frames in which many markers were rejected, none if there are none."""
    count = rejected.sum(axis=1)
    least = np.maximum(limits.at_once * seen.sum(axis=1), limits.least_at_once)
    many = count >= least
    if not many.any():
        return []
    spans = _spans(many, numbers)
    names = quote_names(
        [labels[each] for each in np.flatnonzero(rejected[many].any(axis=0)).tolist()]
    )
    worst = int(np.argmax(count))
    where = "one frame" if many.sum() == 1 else f"{int(many.sum())} frames, the most in frame"
    frame = f", {numbers[worst]}" if many.sum() == 1 else f" {numbers[worst]}"
    words = f"Up to {count[worst]} markers at once were rejected in {where}{frame}: "
    words += f"{', '.join(names)}."
    context = {"labels": names, "frames": spans[: limits.spans], "frame": numbers[worst]}
    return [_add("markers.rejected_frames", "warning", words, **context)]


def _farthest(labels: Sequence[str], numbers: Sequence[int], off: Floats) -> dict[str, Any]:
    """Return whose the greatest distance is, {} where nothing was seen."""
    if not np.isfinite(off).any():
        return {}
    row, column = divmod(int(np.nanargmax(off)), off.shape[1])
    return {"max_label": labels[column], "max_frame": numbers[row]}


def _regions_off(labels: Sequence[str], off: Floats, limits: FitLimits) -> list[Finding]:
    """Return the finding of regions, by the labels' names, that the face does not follow."""
    names = [None if name is None else name.region for name in read_names(labels)]
    groups = np.array(["jaw" if name in LOWER else name or "" for name in names])
    far = {}
    for region in sorted(set(groups.tolist()) - {""}):
        own = groups == region
        mine = rms_of_seen(off[:, own])
        others = rms_of_seen(off[:, ~own])
        least = min(own.sum(), (~own).sum())
        if least >= limits.least_at_once and mine > max(limits.off, limits.region * others):
            far[region] = mine, others
    findings = []
    for region, (mine, others) in sorted(far.items(), key=lambda each: -each[1][0]):
        count = int((groups == region).sum())
        where = region.replace("_", " ")
        words = (
            f"The {where} is not followed: its {count} markers are {mine:.1f} mm off, the others "
            f"{others:.1f} mm (root mean square)."
        )
        context = {"region": region, "found": round(mine, 2), "expected": round(others, 2)}
        findings.append(_add("markers.region_off", "warning", words, **context))
    return findings


def _labels_off(
    labels: Sequence[str], shares: Floats, off: Floats, limits: FitLimits
) -> list[Finding]:
    """Return the finding of labels that are far off though they were hardly ever rejected."""
    rms = np.array([rms_of_seen(column) for column in off.T])
    far = [
        each
        for each in np.argsort(-np.nan_to_num(rms)).tolist()
        if rms[each] > limits.off and shares[each] <= limits.rejected
    ]
    if not far:
        return []
    names = quote_names([labels[each] for each in far])
    shown = [f"{quote(labels[each])} {rms[each]:.1f}" for each in far[: limits.labels]]
    what = count_words(len(far), "label that was kept is", "labels that were kept are")
    words = (
        f"{what} more than {limits.off:g} mm off (root mean square, mm), "
        f"the worst first: {', '.join(shown)}."
    )
    context = {"labels": names, "found": round(float(rms[far[0]]), 2), "expected": limits.off}
    return [_add("markers.label_off", "warning", words, **context)]


def _add(code: str, severity: Severity, message: str, **context: Any) -> Finding:
    return advise(ADVICE, code, severity, message, **context)


def _words(spans: list[list[int]]) -> str:
    first = spans[0][0]
    last = spans[-1][1]
    return f"frame {first}" if first == last else f"frames {first} to {last}"


def _spans(mask: NDArray[np.bool_], numbers: Sequence[int]) -> list[list[int]]:
    """Return the first and last frames, as the take counts, of the runs of what is true."""
    return [[numbers[first], numbers[last]] for first, last in runs(mask)]
