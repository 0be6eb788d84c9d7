"""Bad takes made from good ones: one maker for each fault that a check of markers must name.

Each needs 16 s of a face at 60 frames a second, with markers that it finds by any of their names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline

from solver.errors import Finding
from solver.scans.markers.readers.take import Take
from solver.surface import Floats

# A filling is told by the noise that it lacks. The real takes were filtered: they lack it all over.
NOISE_MM = 0.05
SLACK = 2  # frames by which a fault may be found beside where it begins

# markers by their names in the takes that are spoilt
CHEEK = ("LCheek", "Lcheek_Up")
CHEEK_BELOW = ("LCheek_Down", "Lcheek_Down")
CHEEK_BESIDE = ("LCheek_Up", "Lcheek_Outside")
FAR_CHEEK = ("RCheek_Out", "Rcheek_Outside")
DEAD = ("RCheek", "Rcheek_Down")
BROW = ("LBrow_M", "Leyebrow_M")
BROW_INSIDE = ("LBrow_In", "Leyebrow_Inside")
OTHER_BROW = ("RBrow_M", "Reyebrow_M")
EYE = ("LEye_Out", "Leye_Outside")
FOREHEAD = ("Forehead_L", "ForeHead_L")
CHIN = ("Chin",)
BESIDE_CHIN = ("Chin_L1",)
UPPER = ("UpperLip", "Mouth_Up")
UPPER_LEFT = ("UpperLip_L", "Mouth_UpL1")
UPPER_RIGHT = ("UpperLip_R", "Mouth_UpR1")
LOWER = ("LowerLip", "Mouth_Down")
LOWER_LEFT = ("LowerLip_L", "Mouth_DownL")
LOWER_RIGHT = ("LowerLip_R", "Mouth_DownR")

Names = tuple[str, ...]
Plant = Callable[[Floats, Callable[[Names], int]], None]


@dataclass(frozen=True)
class BadTake:
    """A fault: how a take gets it, and the finding that must name it."""

    code: str
    spoil: Callable[[Take], Take]
    names: Names = ()  # of the marker that has it
    first: int | None = None  # the frame, from 0, in which it begins

    def is_found(self, take: Take, findings: Sequence[Finding]) -> bool:
        """Tell whether exactly one finding names the fault, its label and where it begins."""
        found = [each for each in findings if each.code == self.code]
        if self.names:
            label = take.labels[marker_of(take, self.names)]
            found = [each for each in found if label in _labels_of(each)]
        if len(found) != 1 or self.first is None:
            return len(found) == 1
        context = found[0].context
        began = context["frame"] if "frame" in context else context["frames"][0][0]
        return bool(abs(began - take.first - self.first) <= SLACK)

    def others(self, findings: Sequence[Finding]) -> list[Finding]:
        """Return what is told beside it, and is more than a note."""
        return [each for each in findings if each.code != self.code and each.severity != "info"]


def _labels_of(finding: Finding) -> list[str]:
    """Return the labels that a finding is about; a swap is of two."""
    keys = ["label", "other"] if finding.code == "markers.swapped" else ["label"]
    return [finding.context[key] for key in keys if key in finding.context]


def marker_of(take: Take, names: Names) -> int:
    """Return the marker that has one of the names."""
    return next(take.labels.index(name) for name in names if name in take.labels)


def _planted(
    code: str, plant: Plant, names: Names = (), first: int | None = None, noise_mm: float = 0.0
) -> BadTake:
    def spoil(take: Take) -> Take:
        noise = np.random.default_rng(0).normal(0.0, noise_mm, take.positions.shape)
        positions = take.positions + noise
        plant(positions, lambda wanted: marker_of(take, wanted))
        return replace(take, positions=positions)

    return BadTake(f"markers.{code}", spoil, names, first)


def _changed(code: str, change: Callable[[Floats], Floats]) -> BadTake:
    def spoil(take: Take) -> Take:
        return replace(take, positions=change(take.positions))

    return BadTake(f"markers.{code}", spoil)


At = Callable[[Names], int]


def _dead(points: Floats, at: At) -> None:
    points[:, at(DEAD)] = np.nan


def _frozen(points: Floats, at: At) -> None:
    points[400:430, at(CHEEK)] = points[400, at(CHEEK)]


def _spline(points: Floats, at: At) -> None:
    marker = at(BESIDE_CHIN)
    known = [498, 499, 530, 531]
    points[500:530, marker] = CubicSpline(known, points[known, marker])(np.arange(500, 530))


def _line(points: Floats, at: At) -> None:
    marker = at(BESIDE_CHIN)
    share = np.linspace(0, 1, 32)[1:-1, None]
    points[500:530, marker] = points[499, marker] * (1 - share) + points[530, marker] * share


def _long_gap(points: Floats, at: At) -> None:
    points[200:600, at(CHIN)] = np.nan


def _exchange(points: Floats, first: int, last: int, numbers: Sequence[int]) -> None:
    others = [*numbers[1:], numbers[0]]
    points[first:last, list(numbers)] = points[first:last, others]


def _swap_in_brief(points: Floats, at: At) -> None:
    _exchange(points, 700, 712, [at(UPPER), at(UPPER_LEFT)])


def _swap_for_a_second(points: Floats, at: At) -> None:
    _exchange(points, 500, 560, [at(BROW_INSIDE), at(BROW)])


def _swap_in_a_gap(points: Floats, at: At) -> None:
    pair = [at(CHEEK), at(CHEEK_BESIDE)]
    _exchange(points, 900, len(points), pair)
    points[890:900, pair] = np.nan


def _cycle(points: Floats, at: At) -> None:
    _exchange(points, 600, 640, [at(LOWER), at(LOWER_LEFT), at(LOWER_RIGHT)])


def _spikes(points: Floats, at: At) -> None:
    points[[300, 500, 777], at(BROW)] += [0.0, 5.0, 3.0]


def _burst(points: Floats, at: At) -> None:
    points[650:670, at(FAR_CHEEK)] += [0.0, 14.0, -14.0]


def _ghost(points: Floats, at: At) -> None:
    there = points[540:552, at(EYE)] + [25.0, 5.0, 0.0]
    points[500:600, at(FOREHEAD)] = np.nan
    points[540:552, at(FOREHEAD)] = there


def _relabelled(points: Floats, at: At) -> None:
    points[500:600, at(UPPER_RIGHT)] = np.nan
    points[530:600, at(UPPER_RIGHT)] = points[530:600, at(UPPER)]
    points[530:600, at(UPPER)] = np.nan


def _moved(points: Floats, at: At) -> None:
    way = points[700:, at(CHEEK_BELOW)] - points[700:, at(CHEEK)]
    points[700:, at(CHEEK)] += 5.0 * way / np.linalg.norm(way, axis=1, keepdims=True)


def _double(points: Floats, at: At) -> None:
    points[:, at(BROW_INSIDE)] = points[:, at(BROW)]


def _sides(points: Floats, at: At) -> None:
    _exchange(points, 0, len(points), [at(BROW), at(OTHER_BROW)])


def _gone(points: Floats, _: At) -> None:
    points[300:480] = np.nan


def _two_faces(take: Take) -> Take:
    beside = take.positions + np.array([600.0, 0.0, 0.0])
    labels = (*take.labels, *(f"B_{label}" for label in take.labels))
    return replace(take, positions=np.concatenate([take.positions, beside], axis=1), labels=labels)


BAD_TAKES: dict[str, BadTake] = {
    "a marker is dead": _planted("dead", _dead),
    "frozen": _planted("frozen", _frozen, CHEEK, 401),
    "filled by a spline": _planted("filled", _spline, BESIDE_CHIN, 500, NOISE_MM),
    "filled by a line": _planted("filled", _line, BESIDE_CHIN, 500, NOISE_MM),
    "a long gap": _planted("missing", _long_gap, CHIN, 200),
    "swapped for 0.2 s": _planted("swapped", _swap_in_brief, UPPER, 700),
    "swapped for 1 s": _planted("swapped", _swap_for_a_second, BROW_INSIDE, 500),
    "swapped in a gap, to the end": _planted("swapped", _swap_in_a_gap, CHEEK, 900),
    "three in a circle": _planted("relabelled", _cycle, LOWER, 600),
    "three spikes": _planted("outlier", _spikes, BROW, 300),
    "thrown for 0.3 s": _planted("outlier", _burst, FAR_CHEEK, 650),
    "a ghost in a gap": _planted("ghost", _ghost, FOREHEAD, 540),
    "a neighbour's label": _planted("relabelled", _relabelled, UPPER_RIGHT, 530),
    "fallen off and glued elsewhere": _planted("moved", _moved, CHEEK, 700),
    "two labels of one marker": _planted("double", _double),
    "sides of a pair exchanged": _planted("exchanged", _sides),
    "nothing for 3 s": _planted("gone", _gone, (), 300),
    "mirrored": _changed("mirrored", lambda points: points * [-1.0, 1.0, 1.0]),
    "metres called mm": _changed("unit", lambda points: points / 1000.0),
    "two faces": BadTake("markers.two_faces", _two_faces),
}
"""Fault -> maker."""
