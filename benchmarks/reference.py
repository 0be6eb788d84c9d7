"""The reduced solver against IPOPT: the same minimum, and how much faster.

On a coarse model, forward problem (equilibrium) and activation problem (A) are solved by both, one
after the other in one process, from the same start: the neutral face. ``objective_ratio`` is the
reduced objective over IPOPT's, the one furthest from 1 at top level; ``speedup`` IPOPT's time over
the reduced solver's, the least at top level. An expression that one of them cannot solve has the
reason as ``failed`` and no figures.

The prior is heavier than in a fit: at w_a <= 0.2 the coarse face buckles in a broad smile, where
there are several minima and IPOPT, with the Gauss-Newton Hessian, may not converge.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from benchmarks import plots, report, subjects
from benchmarks.documents import IMAGES, Plot, Section, Table
from benchmarks.subjects import COARSE_EDGE_MM
from solver.errors import SolveError
from solver.fitting import activation, reference
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, PosedFace
from solver.fitting.objective import Regulariser, SkinDistance, Target, Term

CONVERGED = ActivationOptions(max_iterations=200, tolerance=1e-7)

Result = TypeVar("Result")


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--edge-mm", type=float, default=COARSE_EDGE_MM)
    parser.add_argument("--w-a", type=float, default=0.5, help="weight of the activations' prior")
    options = parser.parse_args()
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> dict[str, Any]:
    """Solve every expression by both and return the figures."""
    model, captures = subjects.load(options, options.edge_mm)
    face = Face(model)
    scans = {**captures.train, **captures.test}
    names = list(scans)[: 3 if options.quick else None]
    regulariser = Regulariser(options.w_a, 1e-2, 1e-6, face.rest_pose())
    rest = face.rest
    # compile the kernels before anything is timed
    data = SkinDistance(face, Target.from_points(scans[names[0]].vertices[model.face]))
    activation.fit(face, data, regulariser, rest, ActivationOptions(1))
    expressions = []
    for name in names:
        data = SkinDistance(face, Target.from_points(scans[name].vertices[model.face]))
        try:
            figures = compare(face, data, regulariser, rest)
        except SolveError as error:
            figures = {"failed": str(error)}
        expressions.append({"name": name, **figures})
    solved = [e for e in expressions if "failed" not in e]
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "muscles": model.muscle_count,
        "objective_ratio": furthest_from_one([e["objective_ratio"] for e in solved]),
        "speedup": min(e["speedup"] for e in solved),
        "max_position_difference_mm": max(e["max_position_difference_mm"] for e in solved),
        "forward_speedup": min(e["forward_speedup"] for e in solved),
        "expressions": expressions,
    }


def section(figures: dict[str, Any]) -> Section:
    """Return the document's section."""
    solved = [e for e in figures["expressions"] if "failed" not in e]
    header = ("expression", "objective above IPOPT's", "speed-up", "speed-up, forward")
    rows = [
        [e["name"], e["objective_ratio"] - 1.0, e["speedup"], e["forward_speedup"]] for e in solved
    ]
    failed = [f"{e['name']}: {e['failed']}." for e in figures["expressions"] if "failed" in e]
    times = {
        "A": [e["reduced_seconds"] for e in solved],
        "IPOPT": [e["ipopt_seconds"] for e in solved],
    }
    picture = IMAGES / "reference-seconds.png"
    plots.bars(
        picture,
        "Activations and jaw of one expression",
        "seconds",
        [e["name"] for e in solved],
        times,
    )
    return Section(
        title="The reduced solver against IPOPT",
        compared=(
            f"The same problems on the same coarse model ({figures['vertices']:,} vertices, "
            f"{figures['tets']:,} tets, {figures['muscles']} muscles) from the same start: the "
            "activations and jaw of one expression, and the equilibrium of what was found "
            "(forward). The objectives' difference is relative. IPOPT has exact sparse Jacobians "
            "and the Gauss-Newton Hessian. The shapes found differ by at most "
            f"{figures['max_position_difference_mm']:.1g} mm."
        ),
        parts=[
            Table(header, rows),
            *failed,
            Plot(picture, "Seconds of the reduced solver (A) and of IPOPT for every expression"),
        ],
    )


def compare(face: Face, data: Term, regulariser: Regulariser, rest: PosedFace) -> dict[str, Any]:
    """Fit one expression by both solvers, then simulate its pose by both."""
    reduced, seconds = timed(lambda: activation.fit(face, data, regulariser, rest, CONVERGED))
    full, full_seconds = timed(
        lambda: reference.activations(face, data, regulariser, rest.pose, rest.x)
    )
    pose = reduced.state.pose
    settled, forward_seconds = timed(lambda: face.continuation(rest, pose))
    energy, full_forward_seconds = timed(lambda: ipopt_forward(face, rest, settled))
    return {
        "reduced_objective": reduced.objective,
        "ipopt_objective": full.objective,
        "objective_ratio": reduced.objective / full.objective,
        "ipopt_violation": full.violation,
        "reduced_iterations": reduced.iterations,
        "ipopt_iterations": full.iterations,
        "reduced_seconds": seconds,
        "ipopt_seconds": full_seconds,
        "speedup": full_seconds / seconds,
        "max_position_difference_mm": float(np.linalg.norm(settled.x - energy.x, axis=1).max()),
        "forward_seconds": forward_seconds,
        "ipopt_forward_seconds": full_forward_seconds,
        "forward_speedup": full_forward_seconds / forward_seconds,
    }


def ipopt_forward(face: Face, rest: PosedFace, settled: PosedFace) -> reference.ReferenceSolution:
    """Solve the forward problem by IPOPT from the rest shape carried along with the jaw.

    Where even that start is inverted, IPOPT gets the settled shape shaken by 0.1 mm.
    """
    pose = settled.pose
    start = face.predict(rest, pose)
    try:
        return reference.forward(face, pose, start)
    except SolveError:
        shaken = settled.x.copy()
        noise = np.random.default_rng(0).uniform(-0.1, 0.1, (len(face.flesh.free), 3))
        shaken[face.flesh.free] += noise
        return reference.forward(face, pose, shaken)


def timed(work: Callable[[], Result]) -> tuple[Result, float]:
    """Return what the work returns and its wall time in seconds."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


def furthest_from_one(ratios: list[float]) -> float:
    """Return the ratio that is furthest from 1."""
    return max(ratios, key=lambda ratio: abs(ratio - 1.0))


if __name__ == "__main__":
    main()
