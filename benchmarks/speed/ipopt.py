"""(A) in full space by IPOPT, against the reduced solver: the same minimum, and how much later."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace
from statistics import median

from benchmarks.documents import Figures
from benchmarks.speed.clock import History, Stopwatch
from benchmarks.speed.solvers import CONVERGED, IPOPT_W_A, prepared
from solver.errors import SolveError
from solver.fitting import activation, reference
from solver.fitting.activation import unseen_regulariser
from solver.fitting.face import Face
from solver.fitting.objective import Regulariser, SkinDistance, Target, Term
from solver.fitting.reference import NotConvergedError

IPOPT_ITERATIONS = 200
SAME_OBJECTIVE = 1e-3

REPEATS = 3
"""Runs of the reduced solver, which takes a tenth of a second."""


def against_ipopt(face: Face, targets: Mapping[str, Target]) -> list[Figures]:
    """Solve (A) by the reduced solver and by IPOPT, both from the resting face.

    Ours has what is :func:`prepared` once for all expressions, which IPOPT cannot make use of, and
    the median of some repeats counts.

    An expression that one of them cannot solve has the reason as ``failed``, and where that is
    IPOPT the time it took and the objective of its last iterate. ``same`` tells whether both found
    the same objective. ``ratio`` is of the times that each takes by its own tolerance, 1e-4 and
    IPOPT's 1e-7; ``ratio_same`` of the times after which f is within 0.1 % of its end for good.
    """
    prepared(face)
    regulariser = replace(unseen_regulariser(face), w_a=IPOPT_W_A)
    found = []
    for name, target in targets.items():
        data = SkinDistance(face, target)
        try:
            ours = _reduced(face, data, regulariser)
            theirs = _ipopt(face, data, regulariser)
        except SolveError as error:
            found.append({"name": name, "failed": error.message})
            continue
        figures = {"name": name, **ours, **theirs}
        ratio = figures["objective"] / figures["ipopt_objective"]
        figures["objective_ratio"] = ratio
        if "failed" not in figures:
            figures |= {
                "same": abs(ratio - 1.0) <= SAME_OBJECTIVE,
                "ratio": figures["ipopt_seconds"] / figures["seconds"],
                "ratio_same": figures["ipopt_seconds_same"] / figures["seconds_same"],
            }
        found.append(figures)
    return found


def _reduced(face: Face, data: Term, regulariser: Regulariser) -> Figures:
    seconds = []
    same = []
    for _ in range(REPEATS):
        history = History(time.perf_counter)
        with Stopwatch() as watch:
            fitted = activation.fit(face, data, regulariser, None, CONVERGED, history)
        seconds.append(watch.seconds)
        same.append(history.until(SAME_OBJECTIVE))
    return {"seconds": median(seconds), "seconds_same": median(same), "objective": fitted.objective}


def _ipopt(face: Face, data: Term, regulariser: Regulariser) -> Figures:
    history = History(time.perf_counter)
    failed = {}
    with Stopwatch() as watch:
        try:
            found = reference.activations(
                face,
                data,
                regulariser,
                face.rest.pose,
                face.rest.x,
                max_iterations=IPOPT_ITERATIONS,
                listen=history,
            )
        except NotConvergedError as error:
            found = error.last
            failed = {"failed": error.message}
    return {
        "ipopt_seconds": watch.seconds,
        "ipopt_seconds_same": history.until(SAME_OBJECTIVE),
        "ipopt_objective": found.objective,
        "ipopt_violation": found.violation,
        **failed,
    }
