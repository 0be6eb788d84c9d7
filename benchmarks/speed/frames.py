"""A real performance, frame after frame, and how much is lost against fitting frames alone."""

from __future__ import annotations

import numpy as np

from benchmarks.documents import Figures
from benchmarks.speed.clock import Stopwatch
from solver.fitting import activation
from solver.fitting.activation import ActivationOptions, unseen_regulariser
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face
from solver.fitting.objective import SkinDistance, Target
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DensePoints, SeenPoints
from solver.templates.ict_facekit import IctPerformance

COLD = ActivationOptions(max_iterations=60, tolerance=1e-4)


def frames(face: Face, performance: IctPerformance, numbers: range, compared: int) -> Figures:
    """Fit the frames ``numbers``, and ``compared`` of them cold as well.

    ``frame_ms`` is the time of every frame from its points to its pose. ``loss`` is the mean
    objective of the compared frames over the mean of their cold fits, less one. A frame that can
    not be fitted stays as the one before, and is in ``failed``; ``beyond`` are muscles that any
    frame has outside of what muscles can do.
    """
    limits = face.driven_as(Admissible()).layout.bounds.feasible
    assert limits is not None
    beyond = 0
    regulariser = unseen_regulariser(face)
    rest = face.rest
    tracker = Tracker(DensePoints(face, regulariser))
    alone = set(numbers[:: max(len(numbers) // compared, 1)])
    milliseconds = []
    errors = []
    inverted = 0
    pairs = []
    failed = []
    for number in numbers:
        points = performance.frame(number)[face.model.face]
        target = Target.from_points(points)
        with Stopwatch() as watch:
            found = tracker.step(SeenPoints(points, np.ones(len(points))))
        if found.status != "fitted":
            failed.append(number)
        milliseconds.append(1e3 * watch.seconds)
        state = tracker.state
        errors.append(float(np.nanmean(target.distances(face.face_points(state.x)))))
        inverted += face.flesh.count_inverted(state.x)
        beyond += int((limits.margins(state.pose.a) <= 0.0).any(axis=1).sum())
        if number in alone:
            data = SkinDistance(face, target)
            cold = activation.fit(face, data, regulariser, rest, COLD)
            pairs.append((number, activation.objective(data, regulariser, state), cold.objective))
    kept = sum(objective for _, objective, _ in pairs)
    return {
        "first": numbers.start,
        "frames": len(numbers),
        "median_ms": float(np.median(milliseconds)),
        "mean_ms": float(np.mean(milliseconds)),
        "p95_ms": float(np.percentile(milliseconds, 95)),
        "max_ms": float(np.max(milliseconds)),
        "mean_mm": float(np.mean(errors)),
        "max_mean_mm": float(np.max(errors)),
        "inverted": inverted,
        "beyond": beyond,
        "failed": failed,
        "loss": kept / sum(cold for _, _, cold in pairs) - 1.0,
        "compared": [
            {"frame": number, "objective": warm, "cold_objective": cold}
            for number, warm, cold in pairs
        ],
        "frame_ms": [round(value, 2) for value in milliseconds],
        "frame_mm": [round(value, 4) for value in errors],
    }
