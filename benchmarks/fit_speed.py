"""How long fits and simulations take, all in one run on one subject; ratios are of this run.

Wall times on the threads that the machine gives, kernels compiled. Subject A of the data at 9 mm
tets: ``geometry_seconds`` and ``peak_memory_gib`` of the fit of S; ``activation_ms``, the median of
cold fits of single expressions until a step gains less than 1e-4 of the objective (the resting face
with its Gauss-Newton matrix, ``prepared_ms``, is known: all of them begin with it), and
``ratio_per_tet``, the time of the per-tet model for the same expressions over it; ``frame_ms``, the
median over a recorded performance, with ``frame_mean_mm`` and ``frame_loss`` against frames fitted
alone; the forward problem cold and warm; and the exponents of time by vertices over meshes of
several sizes, for fitting the milder unseen expressions half of the way and for simulating random
plausible poses, which on all of them are the same well-posed problems.
``ratio_ipopt``: (A) by IPOPT over the reduced solver, the median over the expressions of the
built-in face with coarse tets for which both find the same objective within 0.1 %, each to its own
tolerance, and ``ratio_ipopt_same`` until each is within 0.1 % of its end.

Without the data it runs on the built-in person, and without a performance.
"""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Sequence
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks import plots, report, subjects
from benchmarks.documents import IMAGES, Figures, Plot, Section, Table
from benchmarks.round_trip import plausible_pose
from benchmarks.speed import forward, ipopt, solvers
from benchmarks.speed.clock import Stopwatch, peak_gib
from benchmarks.speed.frames import frames
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.fitting import geometry
from solver.fitting.contact import terms
from solver.fitting.face import Face
from solver.fitting.objective import Target, distances
from solver.mechanics.flesh import COROTATED_DET
from solver.mechanics.linear import fastest
from solver.scans.live_link import read_live_link
from solver.templates.export import CaptureSet
from solver.templates.ict_facekit import drive, ict_neutral, read_facekit

SIZES_MM = (19.0, 13.0, 9.0, 5.5)
"""Tets' edges of the scaling: about 1.9, 3.5, 7 and 19 thousand vertices."""

FIRST_FRAME, FRAMES = 2000, 600
"""The liveliest part of the recording: the skin moves 0.3 mm from frame to frame on average."""

PLAUSIBLE = 8
"""Random contractions with an open jaw that are simulated on meshes of all sizes."""

COMPARED = 12
PER_TETS = 3
"""Expressions that the per-tet model, which is slow, is timed on."""

FRAME_LIMIT_MS = 60.0

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    data = Path(os.environ.get("MYOFACE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--recording", type=Path, help="Live Link Face recording")
    parser.add_argument("--first-frame", type=int, default=FIRST_FRAME)
    if data.is_dir():
        parser.set_defaults(
            anatomy=data / "bodyparts3d",
            faces=data / "ict_facekit",
            recording=data / "performance" / "alex_rom_3.csv",
        )
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Measure everything and return the figures."""
    quick = options.quick
    model, captures = subjects.load(options, COARSE_EDGE_MM if quick else EDGE_MM)
    precise, phace = Face(model), Face(model, material=COROTATED_DET)
    # single expressions do with less precision, in jobs too
    face = Face(model, linear=fastest())
    train, test = (
        {name: Target.from_points(scan.vertices[model.face]) for name, scan in scans.items()}
        for scans in (captures.train, captures.test)
    )
    solvers.compile_kernels(face, phace, next(iter(test.values())))
    log.info("geometry")
    with Stopwatch() as watch:
        fitted = geometry.fit(precise, terms(face, train), first_terms=distances(face, train))
    memory = peak_gib()
    log.info("geometry: %.1f s, %.2f GiB", watch.seconds, memory)
    face = face.with_weights(fitted.S)
    preparing = solvers.prepared(face)
    by_a = solvers.activations(face, _first(test, 2 if quick else len(test)))
    log.info("activations: %s", [round(e["seconds"], 2) for e in by_a])
    by_p = solvers.per_tets(phace, _first(test, 1 if quick else PER_TETS))
    log.info("per tet: %s", [round(e["seconds"], 1) for e in by_p])
    poses = {name: state.pose for name, state in fitted.states.items()}
    forwards = forward.forward(face, poses)
    log.info("forward: %s", [round(e["cold_seconds"], 2) for e in forwards])
    sequence = _performance(options, face)
    compared = _against_ipopt(2 if quick else None)
    log.info("IPOPT: %s", [e.get("ratio") for e in compared])
    sizes = _scaling(options, captures, quick)
    log.info("scaling: %s", [round(e["activation_seconds"], 2) for e in sizes])
    seconds = {e["name"]: e["seconds"] for e in by_a}
    same = [e for e in compared if e.get("same")]
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "muscles": model.muscle_count,
        "threads": os.environ.get("NUMBA_NUM_THREADS", str(os.cpu_count())),
        "geometry_seconds": watch.seconds,
        "peak_memory_gib": memory,
        "geometry_mean_mm": geometry.mean_error(face, train, fitted.states),
        "prepared_ms": 1e3 * preparing,
        "activation_ms": 1e3 * median(seconds.values()),
        "ratio_per_tet": median(e["seconds"] / seconds[e["name"]] for e in by_p),
        "ratio_ipopt": median(e["ratio"] for e in same) if same else None,
        "ratio_ipopt_same": median(e["ratio_same"] for e in same) if same else None,
        "ipopt_failed": [e["name"] for e in compared if "failed" in e],
        "frame_ms": sequence and sequence["median_ms"],
        "frame_mean_mm": sequence and sequence["mean_mm"],
        "frame_loss": sequence and sequence["loss"],
        "forward_cold_s": median(e["cold_seconds"] for e in forwards),
        "forward_warm_s": median(e["warm_seconds"] for e in forwards),
        "forward_exponent": exponent(sizes, "forward_seconds"),
        "activation_exponent": exponent(sizes, "activation_seconds"),
        "forward_fitted_exponent": exponent(sizes, "forward_fitted_seconds"),
        "activation_iteration_exponent": exponent(sizes, "activation_iteration_seconds"),
        "activations": by_a,
        "per_tets": by_p,
        "forwards": forwards,
        "ipopt": compared,
        "sizes": sizes,
        "sequence": sequence,
    }


def _first(targets: dict[str, Target], count: int) -> dict[str, Target]:
    return dict(list(targets.items())[:count])


def _performance(options: argparse.Namespace, face: Face) -> Figures | None:
    if options.recording is None:
        return None
    kit = read_facekit(options.faces)
    neutral = ict_neutral(kit, options.faces, options.subject, options.capture_sets).vertices
    take = drive(kit, neutral, read_live_link(options.recording))
    count, compared = (60, 2) if options.quick else (FRAMES, COMPARED)
    numbers = range(options.first_frame, min(options.first_frame + count, len(take)))
    found = frames(face, take, numbers, compared)
    log.info("frames: median %.0f ms, %.3f mm", found["median_ms"], found["mean_mm"])
    return found


def _against_ipopt(count: int | None) -> list[Figures]:
    """Compare with IPOPT on the built-in face, which is small enough for it."""
    model, captures = subjects.load(subjects.builtin_options(), COARSE_EDGE_MM)
    face = Face(model, linear=fastest())
    scans = {**captures.train, **captures.test}
    targets = {name: Target.from_points(scan.vertices[model.face]) for name, scan in scans.items()}
    targets = _first(targets, count or len(targets))
    solvers.compile_kernels(face, None, next(iter(targets.values())))
    return ipopt.against_ipopt(face, targets)


def _scaling(options: argparse.Namespace, captures: CaptureSet, quick: bool) -> list[Figures]:
    edges = SIZES_MM[:2] if quick else SIZES_MM
    models = {edge: subjects.load(options, edge)[0] for edge in edges}
    names = forward.mildest(captures)[: 2 if quick else None]
    common = EDGE_MM if not quick else edges[-1]
    face = Face(models[common])
    plausible = {
        str(seed): plausible_pose(face, np.random.default_rng(seed)) for seed in range(PLAUSIBLE)
    }
    return forward.scaling(models, captures, names, plausible, common)


def exponent(sizes: Sequence[Figures], key: str) -> float:
    """Return the exponent of time ``key`` by vertices."""
    return plots.power_law([e["vertices"] for e in sizes], [e[key] for e in sizes])[0]


def section(figures: Figures) -> Section:
    """Return the document's section."""
    mesh = f"{figures['vertices']:,} vertices and {figures['tets']:,} tets"
    parts: list[Table | Plot | str] = [
        Table(["what", "figure"], [[words, figures[key]] for key, words in HEADLINES.items()]),
        _by_solver(figures),
        Plot(
            _scaling_plot(figures),
            "Seconds by vertices: a plausible pose simulated, half an expression fitted",
        ),
    ]
    if figures["sequence"]:
        sequence = figures["sequence"]
        path = IMAGES / "fit_speed-frames.png"
        title = f"{sequence['frames']} frames from frame {sequence['first']}"
        plots.frame_times(path, title, sequence["frame_ms"], FRAME_LIMIT_MS)
        parts.append(Plot(path, "How long the frames of a recorded performance took"))
    return Section(
        title="Fit speed",
        compared=(
            f"One subject with {mesh} and {figures['muscles']} muscles, {figures['threads']} "
            "threads, everything in one run: the fit of S, of single expressions with S (A) and "
            "by the per-tet model (P), of a performance's frames, and simulation. IPOPT and the "
            "reduced solver are compared on the built-in face with coarse tets."
        ),
        parts=parts,
    )


HEADLINES = {
    "geometry_seconds": "S of five scans, s",
    "peak_memory_gib": "peak memory, GiB",
    "prepared_ms": "what all expressions of a subject begin with, ms",
    "activation_ms": "one expression by A from there, cold, ms",
    "ratio_per_tet": "P's time over A's",
    "ratio_ipopt": "IPOPT's time over the reduced solver's, each to its tolerance",
    "ratio_ipopt_same": "both until f is within 0.1 % of its end",
    "frame_ms": "a frame of the performance, median, ms",
    "frame_mean_mm": "distance to its points, mean, mm",
    "frame_loss": "objective above that of frames fitted alone, relative",
    "forward_cold_s": "simulation, from rest, s",
    "forward_warm_s": "simulation, from 95 % of the way, s",
    "forward_exponent": "exponent of the simulation's time by vertices",
    "forward_fitted_exponent": "the same, of poses that were fitted on one of the meshes",
    "activation_exponent": "exponent of the fit's time by vertices",
    "activation_iteration_exponent": "the fit's, by iteration",
}


def _by_solver(figures: Figures) -> Table:
    by_p = {e["name"]: e for e in figures["per_tets"]}
    rows = [
        [
            e["name"],
            e["seconds"],
            e["mean_mm"],
            e["objective_excess"],
            by_p.get(e["name"], {}).get("seconds"),
            by_p.get(e["name"], {}).get("mean_mm"),
        ]
        for e in figures["activations"]
    ]
    header = ["expression", "A, s", "A, mean mm", "above its minimum", "P, s", "P, mean mm"]
    return Table(header, rows)


def _scaling_plot(figures: Figures) -> Path:
    path = IMAGES / "fit_speed-scaling.png"
    sizes = figures["sizes"]
    seconds: dict[str, list[float]] = {
        name: [e[key] for e in sizes]
        for name, key in (("A", "activation_seconds"), ("simulation", "forward_seconds"))
    }
    plots.scaling(path, "Cost by size", [e["vertices"] for e in sizes], seconds)
    return path


if __name__ == "__main__":
    main()
