"""Convergence of the solvers: the objective by iterations and seconds, on a coarse model.

One expression by activations with S (``A``), by the same problem in full space (``IPOPT``) and by
the per-tet model (``P``), all from the neutral face, until a step gains nothing worth mentioning;
and the mean distance of every training scan, round by round, as S is fitted. Seconds are CPU
seconds, kernels compiled. A solver that fails has the reason in ``failed`` beside its curve.

The prior of A is heavier than in a fit, as in :mod:`benchmarks.reference`: else the coarse face
buckles on the way.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from benchmarks import plots, report, subjects
from benchmarks.documents import IMAGES, Figures, Plot, Section, Table
from benchmarks.plots import Curve
from benchmarks.reference import CONVERGED
from benchmarks.speed.clock import History
from benchmarks.subjects import COARSE_EDGE_MM
from solver.errors import SolveError
from solver.fitting import activation, geometry, per_tet, reference
from solver.fitting.activation import ActivationOptions
from solver.fitting.contact import terms
from solver.fitting.face import Face, PosedFace
from solver.fitting.geometry import GeometryOptions
from solver.fitting.objective import Regulariser, SkinDistance, Target, Term, distances
from solver.fitting.per_tet import PerTetOptions
from solver.mechanics.flesh import COROTATED_DET
from solver.model import SubjectModel

QUICK_ROUNDS = 4
IPOPT_ITERATIONS = 200
PER_TET = PerTetOptions(max_iterations=200, tolerance=1e-7)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--edge-mm", type=float, default=COARSE_EDGE_MM)
    parser.add_argument("--expression", default="kiss", help="the one of A, IPOPT and P")
    parser.add_argument("--w-a", type=float, default=0.5, help="weight of the activations' prior")
    options = parser.parse_args()
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Solve by all and return the figures."""
    model, captures = subjects.load(options, options.edge_mm)
    ids = model.face
    scans = {**captures.train, **captures.test}
    if options.expression not in scans:
        raise SystemExit(f"--expression: one of {', '.join(scans)}")
    targets = {n: Target.from_points(scan.vertices[ids]) for n, scan in captures.train.items()}
    target = Target.from_points(scans[options.expression].vertices[ids])
    rounds = GeometryOptions(rounds=QUICK_ROUNDS) if options.quick else GeometryOptions()
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "expression": options.expression,
        "solvers": _solvers(model, target, options.w_a),
        "rounds_mm": _rounds(Face(model), targets, rounds),
    }


def _solvers(model: SubjectModel, target: Target, w_a: float) -> dict[str, Any]:
    face = Face(model)
    phace = Face(model, material=COROTATED_DET)
    data = SkinDistance(face, target)
    rest = face.rest
    regulariser = Regulariser(w_a, 1e-2, 1e-6, rest.pose)
    _compile(face, phace, data, regulariser, rest)

    def by_activations(listen: History) -> None:
        activation.fit(face, data, regulariser, rest, CONVERGED, listen)

    def by_ipopt(listen: History) -> None:
        reference.activations(
            face,
            data,
            regulariser,
            rest.pose,
            rest.x,
            max_iterations=IPOPT_ITERATIONS,
            listen=listen,
        )

    def per_tet_model(listen: History) -> None:
        per_tet.fit(phace, data, None, PER_TET, listen)

    # all priors are zero at the neutral face; IPOPT tells of its start itself
    neutral = data.value(rest.x)
    found = {}
    for name, solve, start in (
        ("A", by_activations, neutral),
        ("P", per_tet_model, neutral),
        ("IPOPT", by_ipopt, None),
    ):
        history = History(time.process_time, start)
        failed = {}
        try:
            solve(history)
        except SolveError as error:
            failed = {"failed": error.message}
        found[name] = {"objective": history.objective, "seconds": history.seconds, **failed}
    return found


def _compile(
    face: Face, phace: Face, data: Term, regulariser: Regulariser, rest: PosedFace
) -> None:
    activation.fit(face, data, regulariser, rest, ActivationOptions(1))
    per_tet.fit(phace, data, None, PerTetOptions(max_iterations=1))


def _rounds(
    face: Face, targets: Mapping[str, Target], options: GeometryOptions
) -> dict[str, list[float]]:
    """Return the mean distance of every expression as each round begins, and at the end."""
    errors: dict[str, list[float]] = {name: [] for name in targets}

    def listen(_round: int, states: Mapping[str, PosedFace]) -> None:
        for name, state in states.items():
            distance = targets[name].distances(face.face_points(state.estimate))
            errors[name].append(float(np.nanmean(distance)))

    data = terms(face, targets)
    first_terms = distances(face, targets)
    fitted = geometry.fit(face, data, options, first_terms=first_terms, listen=listen)
    listen(options.rounds, fitted.states)
    return errors


def section(figures: Figures) -> Section:
    """Return the document's section."""
    solvers = figures["solvers"]
    curves = {name: Curve(found["objective"], found["seconds"]) for name, found in solvers.items()}
    convergence, rounds = (IMAGES / f"convergence-{name}.png" for name in ("objective", "rounds"))
    title = f"{figures['expression']}: objective from its end"
    plots.convergence(convergence, title, curves)
    plots.descent(rounds, "S from all training scans", "mean distance, mm", figures["rounds_mm"])
    rows = [
        [
            name,
            len(found["objective"]) - 1,
            found["seconds"][-1],
            found["objective"][-1],
            found.get("failed", ""),
        ]
        for name, found in solvers.items()
    ]
    return Section(
        title="Convergence",
        compared=(
            f"One expression ({figures['expression']}) on a coarse model ({figures['vertices']:,} "
            f"vertices, {figures['tets']:,} tets) from the neutral face, with tolerances far below "
            "those of a fit: activations with the geometric S (A), the same problem in full space "
            "(IPOPT), and the per-tet model (P), whose objective is another one. Seconds are CPU "
            "seconds. Below, the mean distance of every training scan, round by round, as S is "
            "fitted to all."
        ),
        parts=[
            Table(["solver", "iterations", "seconds", "objective at the end", "failed"], rows),
            Plot(
                convergence, "Distance of the objective from its end by iterations and by seconds"
            ),
            Plot(rounds, "Mean distance of every training scan after each round"),
        ],
    )


if __name__ == "__main__":
    main()
