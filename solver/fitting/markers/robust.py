"""Separate right markers from wrong ones in one frame, before the face is fitted to them.

    p ~ N(predicted, S),    o_k = p_k + e_k,    e_k ~ N(0, Lambda_k^-1 / w_k)

p (3 k,) are the markers' places in the take: the spread S comes from the controls and the head as
they are before the frame (:mod:`.prediction`). Weights w are Geman and McClure's (1987), graduated:
their scale falls round by round, so that a wrong marker loses its weight before it has bent the
face (Blake and Zisserman 1987). What a label lost is looked for among points of other labels and of
tracks without one, by assignment to the predicted places: swaps and ghosts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from solver.fitting.markers.prediction import Prediction
from solver.fitting.markers.term import HeadOptions, HeadPrior, MarkerPlaces, MarkerTerm
from solver.similarity import robust_weights
from solver.surface import Floats

MarkerState = Literal["seen", "missing", "outlier", "swapped", "relabelled"]


@dataclass(frozen=True)
class RobustOptions:
    """Scales of the weights, and what is too far off to be a marker's."""

    scales: tuple[float, ...] = (4.0, 2.0, 1.0)  # of the rounds, times ``scale_mm``
    scale_mm: float = 1.8
    least_weight: float = 0.02  # below it, at 2.5 times the scale, a marker is an outlier
    gate_mm: float = 2.5  # of another's point that is taken for a marker ...
    gate_sd: float = 2.0  # ... and the predicted spread that comes to it
    most_gate_mm: float = 8.0
    better: float = 2.0  # times as far has the label's own point to be

    @property
    def lenient_scales(self) -> tuple[float, ...]:
        """Scales for points that passed: of the rounds, none below twice the last."""
        least = 2.0 * self.scales[-1]
        return (*(each for each in self.scales if each > least), least)


@dataclass(frozen=True)
class JudgedFrame:
    """A frame's points with the labels that they are, their weights and states."""

    points: Floats  # (k, 3) NaN where there is none
    weights: Floats  # (k,) in [0, 1]
    states: NDArray[np.str_]  # (k,) of MarkerState


def judge(
    prediction: Prediction,
    seen: Floats,
    precision: Floats,
    unlabelled: Floats,
    options: RobustOptions = RobustOptions(),
) -> JudgedFrame:
    """Weigh a frame's points ``seen`` (k, 3) and give those that are wrong to whom they belong.

    ``precision`` (k, 3) is that of right points, ``unlabelled`` (u, 3) may hold NaN.
    """
    present = np.asarray(np.isfinite(seen).all(axis=1))
    states = np.where(present, "seen", "missing").astype("<U10")
    rounds = _rounds(prediction, seen, precision, options.scales, options)
    weights = _weights(seen, rounds[-1], options.scales[-1], options)
    wrong = present & (weights < options.least_weight)
    states[wrong] = "outlier"
    points = seen.copy()
    if wrong.any() or (len(unlabelled) and not present.all()):
        right = (present & ~wrong)[:, None]
        counted = np.where(right, precision * weights[:, None], 0.0)
        after = prediction.condition(np.where(right, seen, 0.0), counted)
        for label, point, state in _assign(after, seen, states, unlabelled, options):
            points[label] = point
            states[label] = state
    used = (states != "outlier") & (states != "missing")
    lenient = options.lenient_scales
    is_same = np.array_equal(used, present) and np.array_equal(points, seen, equal_nan=True)
    # with no point changed the first rounds are those of lenient scales
    if not is_same or lenient != options.scales[: len(lenient)]:
        rounds = _rounds(prediction, points, precision * used[:, None], lenient, options)
    weights = _weights(points, rounds[len(lenient)], lenient[-1], options)
    # a label that was given a point does not keep one that the others contradict
    again = used & (weights < options.least_weight)
    states[again] = "outlier"
    return JudgedFrame(points, np.where(used & ~again, weights, 0.0), states)


@dataclass(frozen=True)
class Judge:
    """Judges the points of markers at ``places``, and makes a term of fits of what counts."""

    places: MarkerPlaces
    robust: RobustOptions
    head: HeadOptions

    def term(
        self,
        head: HeadPrior,
        prediction: Prediction,
        seen: Floats,
        precision: Floats,
        unlabelled: Floats | None = None,
    ) -> tuple[JudgedFrame, MarkerTerm]:
        """Return a frame judged, and its term: the precision of a point is 0 where it is wrong.

        ``head`` is what is known of it before the frame; other arguments are those of
        :func:`judge`.
        """
        free = np.zeros((0, 3)) if unlabelled is None else unlabelled
        judged = judge(prediction, seen, precision, free, self.robust)
        used = precision * judged.weights[:, None]
        target = np.where(used > 0.0, judged.points, np.nan)
        return judged, MarkerTerm(self.places, target, used, head, self.head)


def _rounds(
    prediction: Prediction,
    seen: Floats,
    precision: Floats,
    scales: tuple[float, ...],
    options: RobustOptions,
) -> list[Floats]:
    """Return the places (k, 3) that each round of weighing starts from, and the last one's."""
    known = np.asarray(np.isfinite(seen).all(axis=1))
    exact = np.where(known[:, None], precision, 0.0)
    points = np.where(known[:, None], seen, 0.0)
    places = [prediction.points]
    for scale in scales:
        weights = np.maximum(_weights(seen, places[-1], scale, options), 1e-9)
        places.append(prediction.conditional_mean(points, exact * weights[:, None]))
    return places


def _weights(seen: Floats, places: Floats, scale: float, options: RobustOptions) -> Floats:
    """Return weights (k,) of points by their distance from their places, 0 where none was seen."""
    off = np.linalg.norm(seen - places, axis=1) / (scale * options.scale_mm)
    return np.where(np.isnan(off), 0.0, robust_weights(np.nan_to_num(off) ** 2))


def _assign(
    after: Prediction,
    seen: Floats,
    states: NDArray[np.str_],
    unlabelled: Floats,
    options: RobustOptions,
) -> list[tuple[int, Floats, MarkerState]]:
    """Return labels that take a point near their places ``after`` the right points are known.

    They are given as number, point and what that makes of the label.
    """
    owners = np.flatnonzero(states == "outlier")
    labels = np.flatnonzero((states == "outlier") | (states == "missing"))
    candidates = np.concatenate([seen[owners], unlabelled[np.isfinite(unlabelled).all(axis=1)]])
    if not len(labels) or not len(candidates):
        return []
    gates = np.minimum(options.gate_mm + options.gate_sd * after.sd[labels], options.most_gate_mm)
    away = np.linalg.norm(after.points[labels][:, None] - candidates, axis=2)
    rows, columns = linear_sum_assignment(np.minimum(away / gates[:, None], 1.0))
    found: list[tuple[int, Floats, MarkerState]] = []
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        label = int(labels[row])
        other = column >= len(owners) or owners[column] != labels[row]
        own = np.linalg.norm(seen[label] - after.points[label])  # NaN: it has none
        near = away[row, column]
        if other and near <= gates[row] and not own < options.better * near:
            state: MarkerState = "swapped" if column < len(owners) else "relabelled"
            found.append((label, candidates[column], state))
    return found
