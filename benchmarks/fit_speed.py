"""Times of fits and simulations on one subject; ratios are of one run.

Wall times on the threads that the machine gives, kernels compiled; ``--parts`` chooses what is
timed, so that no run takes long, and with ``--rig`` S is fitted once for several runs. Muscles are
divided and expressions fitted within what muscles can do, as in jobs, unless ``--whole`` and
``--controls free`` say otherwise; the comparison with IPOPT and that of meshes fit freely. Subject
A of the data at 9 mm tets: ``geometry_seconds`` and ``peak_memory_gib`` of the fit of S;
``activation_ms``, the median of cold fits of single expressions until a step gains less than 1e-4
of the objective (the resting face with its Gauss-Newton matrix, ``prepared_ms``, is known: all of
them begin with it), and ``ratio_per_tet``, the time of the per-tet model for the same expressions
over it; ``frame_ms``, the median over a recorded performance, with ``frame_mean_mm`` and
``frame_loss`` against frames fitted alone, of free muscles and within what muscles can do
(``frame_within_ms`` and so on); the forward problem cold and warm; and the exponents of time by
vertices over meshes of several sizes, for fitting the milder unseen expressions half of the way and
for simulating random plausible poses, which on all of them are the same well-posed problems.
``ratio_ipopt``: (A) by IPOPT over the reduced solver, the median over the expressions of the
built-in face with coarse tets for which both find the same objective within 0.1 %, each to its own
tolerance, and ``ratio_ipopt_same`` until each is within 0.1 % of its end.

Without the data it runs on the built-in person, and without a performance.
"""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from statistics import median

import numpy as np

from benchmarks import plots, report, subjects
from benchmarks.documents import IMAGES, Figures, Plot, Section, Table
from benchmarks.round_trip import plausible_pose
from benchmarks.speed import forward, ipopt, solvers
from benchmarks.speed.clock import peak_gib
from benchmarks.speed.frames import frames
from benchmarks.subject_fits import by_geometry
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Target
from solver.mechanics.flesh import COROTATED_DET
from solver.mechanics.linear import fastest
from solver.rig import Rig
from solver.scans.live_link import read_live_link
from solver.templates.ict_facekit import drive, ict_neutral, read_facekit

SIZES_MM = (19.0, 13.0, 9.0, 5.5)
"""Tets' edges of the scaling: about 1.9, 3.5, 7 and 19 thousand vertices."""

FIRST_FRAME = 2000
FRAMES = 600
"""The liveliest part of the recording: the skin moves 0.3 mm from frame to frame on average."""

PLAUSIBLE = 8
"""Random contractions with an open jaw that are simulated on meshes of all sizes."""

COMPARED = 12
PER_TETS = 3
"""Expressions that the per-tet model, which is slow, is timed on."""

QUICK_FRAMES = 60

FRAME_LIMIT_MS = 60.0

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    subjects.add_controls(parser)
    report.add_list(parser, "--parts", PARTS)
    parser.add_argument("--rig", type=Path, help="rig of S: read if there, else S is left in it")
    parser.add_argument("--recording", type=Path, help="Live Link Face recording")
    parser.add_argument("--first-frame", type=int, default=FIRST_FRAME)
    subjects.default_to_data(parser)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Measure the parts that were asked for and return their figures."""
    person = Person(options)
    figures: Figures = {
        "vertices": len(person.model.rest),
        "tets": len(person.model.tets),
        "muscles": person.model.muscle_count,
        "controls": options.controls,
        "threads": os.environ.get("NUMBA_NUM_THREADS", str(os.cpu_count())),
    }
    for part in options.parts:
        found = PARTS[part](person)
        log.info("%s: %s", part, {k: v for k, v in found.items() if not isinstance(v, list | dict)})
        figures |= found
    seconds = {e["name"]: e["seconds"] for e in figures.get("activations", ())}
    ratios = [
        e["seconds"] / seconds[e["name"]]
        for e in figures.get("per_tets", ())
        if e["name"] in seconds
    ]
    return {**figures, "ratio_per_tet": median(ratios)} if ratios else figures


class Person:
    """The subject, whose S is fitted once, by the first part that asks for it."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self.model, self.captures = subjects.load(
            options, COARSE_EDGE_MM if options.quick else EDGE_MM
        )

    def targets(self, count: int) -> dict[str, Target]:
        """Return the first of the unseen expressions; two at most in a quick run."""
        chosen = list(self.captures.test.items())[: 2 if self.options.quick else count]
        return {n: Target.from_points(scan.vertices[self.model.face]) for n, scan in chosen}

    @cached_property
    def fitted(self) -> tuple[Rig, Figures]:
        """The rig of the training scans, and the figures of its fit if it was fitted here."""
        path = self.options.rig
        if path is not None and path.is_file():
            return Rig.load(path), {}
        face = self.compile(Face(self.model))
        schedule = subjects.schedule(self.options, self.model, quick=self.options.quick)
        fits = by_geometry(face, self.captures.train, schedule)
        rig = Rig(self.model, fits.face.S, tuple(fits.expressions("train")))
        if path is not None:
            rig.save(path)
        return rig, {
            "geometry_seconds": fits.seconds,
            "peak_memory_gib": peak_gib(),
            "geometry_mean_mm": fits.mean_mm,
        }

    @cached_property
    def face(self) -> Face:
        """The fitted face, free; single expressions do with less precision, in jobs too."""
        return Face(self.model, self.fitted[0].weights, linear=fastest())

    def compile(self, face: Face, phace: Face | None = None) -> Face:
        """Return the face after its kernels, and those of the per-tet model's, are compiled."""
        solvers.compile_kernels(face, phace, next(iter(self.targets(1).values())))
        return face


def _geometry(person: Person) -> Figures:
    return person.fitted[1]


def _activations(person: Person) -> Figures:
    face = person.compile(subjects.bounded(person.face, person.options))
    preparing = solvers.prepared(face)
    found = solvers.activations(face, person.targets(len(person.captures.test)))
    return {
        "prepared_ms": 1e3 * preparing,
        "activation_ms": 1e3 * median(e["seconds"] for e in found),
        "activations": found,
    }


def _per_tets(person: Person) -> Figures:
    phace = Face(person.model, material=COROTATED_DET)
    person.compile(Face(person.model), phace)
    return {"per_tets": solvers.per_tets(phace, person.targets(PER_TETS))}


def _forward(person: Person) -> Figures:
    poses = {each.name: Pose(each.activations, each.jaw) for each in person.fitted[0].expressions}
    found = forward.forward(person.face, poses)
    return {
        "forward_cold_s": median(e["cold_seconds"] for e in found),
        "forward_warm_s": median(e["warm_seconds"] for e in found),
        "forwards": found,
    }


def _performance(person: Person) -> Figures:
    options = person.options
    if options.recording is None:
        return {}
    kit = read_facekit(options.faces)
    neutral = ict_neutral(kit, options.faces, options.subject, options.capture_sets).vertices
    take = drive(kit, neutral, read_live_link(options.recording))
    count, compared = (QUICK_FRAMES, 2) if options.quick else (FRAMES, COMPARED)
    numbers = range(options.first_frame, min(options.first_frame + count, len(take)))
    found = frames(person.compile(person.face), take, numbers, compared)
    figures: Figures = {
        "frame_ms": found["median_ms"],
        "frame_mean_mm": found["mean_mm"],
        "frame_loss": found["loss"],
        "sequence": found,
    }
    if options.controls == "free":
        return figures
    within = frames(person.compile(subjects.bounded(person.face, options)), take, numbers, compared)
    return figures | {
        "frame_within_ms": within["median_ms"],
        "frame_within_mm": within["mean_mm"],
        "frame_within_loss": within["loss"],
        "sequence_within": within,
    }


def _against_ipopt(person: Person) -> Figures:
    """Compare with IPOPT, which knows no bounds, on the built-in face, small enough for it."""
    model, captures = subjects.load(subjects.builtin_options(), COARSE_EDGE_MM)
    face = Face(model, linear=fastest())
    scans = {**captures.train, **captures.test}
    names = list(scans)[: 2 if person.options.quick else None]
    targets = {name: Target.from_points(scans[name].vertices[model.face]) for name in names}
    solvers.compile_kernels(face, None, targets[names[0]])
    found = ipopt.against_ipopt(face, targets)
    same = [e for e in found if e.get("same")]
    return {
        "ratio_ipopt": median(e["ratio"] for e in same) if same else None,
        "ratio_ipopt_same": median(e["ratio_same"] for e in same) if same else None,
        "ipopt_failed": [e["name"] for e in found if "failed" in e],
        "ipopt": found,
    }


def _scaling(person: Person) -> Figures:
    """Fit and simulate on meshes of several sizes, freely: the same problem on all of them."""
    options = person.options
    edges = SIZES_MM[:2] if options.quick else SIZES_MM
    models = {edge: subjects.load(options, edge)[0] for edge in edges}
    names = forward.mildest(person.captures)[: 2 if options.quick else None]
    common = edges[-1] if options.quick else EDGE_MM
    face = Face(models[common])
    plausible = {
        str(seed): plausible_pose(face, np.random.default_rng(seed)) for seed in range(PLAUSIBLE)
    }
    sizes = forward.scaling(models, person.captures, names, plausible, common)
    return {
        "forward_exponent": exponent(sizes, "forward_seconds"),
        "activation_exponent": exponent(sizes, "activation_seconds"),
        "forward_fitted_exponent": exponent(sizes, "forward_fitted_seconds"),
        "activation_iteration_exponent": exponent(sizes, "activation_iteration_seconds"),
        "sizes": sizes,
    }


PARTS: dict[str, Callable[[Person], Figures]] = {
    "geometry": _geometry,
    "activation": _activations,
    "per_tet": _per_tets,
    "forward": _forward,
    "frames": _performance,
    "ipopt": _against_ipopt,
    "scaling": _scaling,
}


def exponent(sizes: Sequence[Figures], key: str) -> float:
    """Return the exponent of time ``key`` by vertices."""
    return plots.power_law([e["vertices"] for e in sizes], [e[key] for e in sizes])[0]


def section(figures: Figures) -> Section:
    """Return the document's section."""
    mesh = f"{figures['vertices']:,} vertices and {figures['tets']:,} tets"
    headlines = [[words, figures[key]] for key, words in HEADLINES.items() if key in figures]
    parts: list[Table | Plot | str] = [Table(["what", "figure"], headlines)]
    if "activations" in figures:
        parts.append(_by_solver(figures))
    if "sizes" in figures:
        caption = "Seconds by vertices: a plausible pose simulated, half an expression fitted"
        parts.append(Plot(_scaling_plot(figures), caption))
    if "sequence" in figures:
        sequence = figures["sequence"]
        path = IMAGES / "fit_speed-frames.png"
        title = f"{sequence['frames']} frames from frame {sequence['first']}"
        plots.frame_times(path, title, sequence["frame_ms"], FRAME_LIMIT_MS)
        parts.append(Plot(path, "How long the frames of a recorded performance took"))
    return Section(
        title="Fit speed",
        compared=(
            f"One subject with {mesh} and {figures['muscles']} muscles, {figures['controls']} "
            f"controls, {figures['threads']} threads, in one run: the fit of S, of single "
            "expressions with S (A) and by the per-tet model (P), of a performance's frames, and "
            "simulation. IPOPT and the reduced solver are compared with free controls on the "
            "built-in face with coarse tets, and so are meshes of several sizes."
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
    "frame_within_ms": "a frame within what muscles can do, median, ms",
    "frame_within_mm": "distance to its points, mean, mm",
    "frame_within_loss": "objective above that of frames fitted alone, relative",
    "forward_cold_s": "simulation, from rest, s",
    "forward_warm_s": "simulation, from 95 % of the way, s",
    "forward_exponent": "exponent of the simulation's time by vertices",
    "forward_fitted_exponent": "the same, of poses that were fitted on one of the meshes",
    "activation_exponent": "exponent of the fit's time by vertices",
    "activation_iteration_exponent": "the fit's, by iteration",
}


def _by_solver(figures: Figures) -> Table:
    by_p = {e["name"]: e for e in figures.get("per_tets", ())}
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
