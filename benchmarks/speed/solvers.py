"""One expression by activations with S (A) and by the per-tet model (P)."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping

import numpy as np

from benchmarks.documents import Figures
from benchmarks.speed.clock import Stopwatch
from solver.errors import SolveError
from solver.fitting import activation, per_tet
from solver.fitting.activation import (
    ActivationFit,
    ActivationOptions,
    rest_curvature,
    unseen_regulariser,
)
from solver.fitting.face import Face
from solver.fitting.objective import SkinDistance, Target
from solver.fitting.per_tet import PerTetOptions

TOLERANCE = 1e-4
"""Gain of a step, as a part of the objective, below which a solve ends."""

CONVERGED = ActivationOptions(max_iterations=60, tolerance=TOLERANCE)
FURTHER = ActivationOptions(max_iterations=60, tolerance=1e-7)
PER_TET = PerTetOptions(max_iterations=200, tolerance=TOLERANCE)

IPOPT_W_A = 0.05
"""Prior's weight, the lightest with which IPOPT converges on the coarse model for nearly every
expression. With 0.02 it fails for most of them. The scaling has it on all meshes."""


def activations(face: Face, targets: Mapping[str, Target]) -> list[Figures]:
    """Fit every target by A, cold: from the resting face, which is :func:`prepared`."""
    regulariser = unseen_regulariser(face)
    found = []
    for name, target in targets.items():
        data = SkinDistance(face, target)
        with Stopwatch() as watch:
            fitted = activation.fit(face, data, regulariser, options=CONVERGED)
        further = activation.descend(face, data, regulariser, fitted.state, FURTHER)
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


def prepared(face: Face) -> float:
    """Make what all expressions of a face begin with, and return the seconds that it took."""
    with Stopwatch() as watch:
        rest_curvature(face)
    return watch.seconds


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


def compile_kernels(face: Face, phace: Face | None, target: Target) -> None:
    """Run every solver for a moment, so that no compilation is timed."""
    rest = face.rest
    data = SkinDistance(face, target)
    regulariser = unseen_regulariser(face)
    activation.fit(face, data, regulariser, rest, ActivationOptions(1))
    if phace is not None:
        with contextlib.suppress(SolveError):
            per_tet.fit(phace, data, None, PerTetOptions(max_iterations=1))


def mean_mm(face: Face, target: Target, fitted: ActivationFit) -> float:
    """Return the mean distance over the face skin."""
    return float(np.nanmean(target.distances(face.face_points(fitted.state.x))))
