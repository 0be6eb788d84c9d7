"""One expression by activations with S (A), by the per-tet model (P) and in full space by IPOPT."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import replace
from statistics import median

import numpy as np
import scipy.sparse as sp

from benchmarks.documents import Figures
from benchmarks.speed.clock import History, Stopwatch
from solver.errors import SolveError
from solver.fitting import activation, per_tet, reference, standard
from solver.fitting.activation import ActivationFit, ActivationOptions
from solver.fitting.face import Face
from solver.fitting.objective import Target
from solver.fitting.per_tet import PerTetOptions
from solver.fitting.reference import NotConvergedError
from solver.fitting.resting import Resting
from solver.fitting.terms import SkinDistance

TOLERANCE = 1e-4
"""Gain of a step, as a part of the objective, below which a solve ends."""

CONVERGED = ActivationOptions(max_iterations=60, tolerance=TOLERANCE)
FURTHER = ActivationOptions(max_iterations=60, tolerance=1e-7)
PER_TET = PerTetOptions(max_iterations=200, tolerance=TOLERANCE)

IPOPT_W_A = 0.05
"""Prior's weight, the lightest with which IPOPT converges on the coarse model for nearly every
expression. With 0.02 it fails for most of them. The scaling has it on all meshes."""

IPOPT_ITERATIONS = 200
SAME_OBJECTIVE = 1e-3

REPEATS = 3
"""Runs of the reduced solver on the coarse face, where it takes a tenth of a second."""


def activations(face: Face, S: sp.csr_array, targets: Mapping[str, Target]) -> list[Figures]:
    """Fit every target by A, cold: from the resting face, which is :func:`prepared`."""
    regulariser, (rest, _) = standard.unseen_regulariser(face), prepared(face, S)
    found = []
    for name, target in targets.items():
        data = SkinDistance(face, target)
        with Stopwatch() as watch:
            fitted = activation.fit(
                face, S, data, regulariser, rest.state, CONVERGED, matrix=rest.matrix
            )
        further = activation.improve(face, S, data, regulariser, fitted.state, FURTHER)
        found.append(
            {
                "name": name,
                "seconds": watch.seconds,
                "iterations": fitted.iterations,
                "mean_mm": mean_mm(face, target, fitted),
                "objective_excess": fitted.objective / further.objective - 1.0,
            }
        )
    return found


def prepared(face: Face, S: sp.csr_array) -> tuple[Resting, float]:
    """Return what all expressions of a face begin with, ready and factorised, and its seconds."""
    with Stopwatch() as watch:
        rest = Resting(face, S)
        _ = rest.matrix
    return rest, watch.seconds


def per_tets(face: Face, targets: Mapping[str, Target]) -> list[Figures]:
    """Fit every target by P, cold; ``face`` has its material."""
    found = []
    for name, target in targets.items():
        data = SkinDistance(face, target)
        with Stopwatch() as watch:
            fitted = per_tet.fit(face, data, None, PER_TET)
        distances = target.distances(face.face_points(fitted.state.x))
        found.append(
            {
                "name": name,
                "seconds": watch.seconds,
                "iterations": fitted.iterations,
                "mean_mm": float(np.nanmean(distances)),
            }
        )
    return found


def against_ipopt(face: Face, targets: Mapping[str, Target]) -> list[Figures]:
    """Solve (A) by the reduced solver and by IPOPT, both from the resting face.

    Ours has what is :func:`prepared` once for all expressions, which IPOPT can not make use of, and
    the median of some repeats counts.

    Where IPOPT does not converge its reason is in ``failed``, with the time it took and the
    objective of its last iterate. ``same`` tells whether both found the same objective. ``ratio``
    is of the times that each takes by its own tolerance, 1e-4 and IPOPT's 1e-7; ``ratio_same`` of
    the times after which f is within 0.1 % of its end for good.
    """
    S = face.model.weights
    rest, _ = prepared(face, S)
    regulariser = replace(standard.unseen_regulariser(face), w_a=IPOPT_W_A)
    found = []
    for name, target in targets.items():
        data = SkinDistance(face, target)
        seconds, same = [], []
        for _ in range(REPEATS):
            ours = History(time.perf_counter)
            with Stopwatch() as watch:
                fitted = activation.fit(
                    face, S, data, regulariser, rest.state, CONVERGED, ours, matrix=rest.matrix
                )
            seconds.append(watch.seconds)
            same.append(ours.until(SAME_OBJECTIVE))
        taken = median(seconds)
        figures: Figures = {"name": name, "seconds": taken, "objective": fitted.objective}
        theirs = History(time.perf_counter)
        with Stopwatch() as ipopt:
            try:
                full = reference.activations(
                    face,
                    S,
                    data,
                    regulariser,
                    rest.state.pose,
                    rest.state.x,
                    max_iterations=IPOPT_ITERATIONS,
                    listen=theirs,
                )
            except NotConvergedError as error:
                full = error.last
                figures["failed"] = error.message
        ratio = fitted.objective / full.objective
        figures |= {
            "ipopt_seconds": ipopt.seconds,
            "ipopt_objective": full.objective,
            "ipopt_violation": full.violation,
            "objective_ratio": ratio,
        }
        if "failed" in figures:
            found.append(figures)
            continue
        found.append(
            {
                **figures,
                "same": abs(ratio - 1.0) <= SAME_OBJECTIVE,
                "ratio": ipopt.seconds / taken,
                "ratio_same": theirs.until(SAME_OBJECTIVE) / median(same),
            }
        )
    return found


def compile_kernels(face: Face, phace: Face | None, target: Target) -> None:
    """Run every solver for a moment, so that no compilation is timed."""
    S, rest = face.model.weights, face.rest_state(face.model.weights)
    data = SkinDistance(face, target)
    regulariser = standard.unseen_regulariser(face)
    activation.fit(face, S, data, regulariser, rest, ActivationOptions(1))
    if phace is not None:
        with contextlib.suppress(SolveError):
            per_tet.fit(phace, data, None, PerTetOptions(max_iterations=1))


def mean_mm(face: Face, target: Target, fitted: ActivationFit) -> float:
    """Return the mean distance over the face skin."""
    return float(np.nanmean(target.distances(face.face_points(fitted.state.x))))
