"""How near fitted faces come to their scans, by muscle geometry (S) and by the per-tet model (P).

For every subject of the capture sets S is fitted to the training scans and activations alone to
the test scans, by the functions and weights of the jobs. Distances are over the face skin, vertex
by vertex, in mm. ``ablation_ratio`` is the training scans' mean with activations alone (the
geometric S of the model) over that with the fitted S; ``three_scans_test_mean_mm`` the test scans'
mean with an S of the first three training scans; ``followed_S`` and ``followed_P`` the part of a
bump that the fits follow, on the cheek of the test scan whose cheek is the calmest. The worst
subject is at top level. Subjects run side by side, as many as there are cores.
"""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numba
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks import documents, pictures, plots, report, subject_fits, subjects
from benchmarks.artifact import add_bump, cheek, followed
from benchmarks.documents import Figures, Plot, Section, Table
from benchmarks.pictures import Compared
from benchmarks.subject_fits import Fits
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.errors import InputError
from solver.fitting.face import Face
from solver.fitting.geometry import GeometryOptions
from solver.fitting.per_tet import PerTetOptions
from solver.mechanics.flesh import COROTATED_DET
from solver.model import SubjectModel
from solver.templates.export import CaptureSet

QUICK_ROUNDS = 6
FEW_SCANS = 3

WORST: dict[str, Callable[[list[Any]], Any]] = {
    "train_mean_mm": max,
    "test_mean_mm": max,
    "inverted": sum,
    "lip_crossing_max_mm": max,
    "ablation_ratio": min,
    "three_scans_test_mean_mm": max,
    "followed_P": min,
    "followed_S": max,
    "per_tet_train_mean_mm": max,
    "per_tet_inverted": sum,
}
"""What stands at top level, and how it is chosen among the subjects."""

COLUMNS = {
    "train_mean_mm": "training, mm",
    "test_mean_mm": "unseen, mm",
    "inverted": "inverted tets",
    "lip_crossing_max_mm": "lips crossing, mm",
    "ablation_mean_mm": "geometric S, training, mm",
    "three_scans_test_mean_mm": "S of three scans, unseen, mm",
    "per_tet_train_mean_mm": "P, training, mm",
    "per_tet_inverted": "P, inverted tets",
    "followed_S": "bump followed by S",
    "followed_P": "by P",
}
DETAILS = {
    "mean_mm": "mean, mm",
    "p95_mm": "95 % below, mm",
    "max_mm": "max, mm",
    "inverted": "inverted tets",
    "lip_crossing_mm": "lips crossing, mm",
    "scan_lip_crossing_mm": "in the scan, mm",
}

Job = tuple[str, SubjectModel, CaptureSet, argparse.Namespace]

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_folders(parser)
    parser.add_argument("--subjects", type=_names, default=["A", "B", "C"], metavar="LIST")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the fits by S and P")
    options = parser.parse_args()
    try:
        figures = run(options)
    except InputError as fault:
        raise SystemExit(f"{fault.code}: {fault.message}") from None
    report.finish(figures, options, section)


def _names(text: str) -> list[str]:
    names = [word.strip() for word in text.split(",") if word.strip()]
    if not names:
        raise argparse.ArgumentTypeError("at least one subject")
    return list(dict.fromkeys(names))


def run(options: argparse.Namespace) -> Figures:
    """Fit every subject and return the figures."""
    names = options.subjects[: 1 if options.quick else None]
    edge = COARSE_EDGE_MM if options.quick else EDGE_MM
    jobs = [(*person, options) for person in subjects.each(options, names, edge)]
    cores = os.cpu_count() or 1
    workers = min(len(jobs), cores)
    with ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=_begin, initargs=(cores // workers,)
    ) as pool:
        found = list(pool.map(_safely, jobs))
    people = {}
    for (name, *_), figures in zip(jobs, found, strict=True):
        if isinstance(figures, dict):
            people[name] = figures
        else:
            raise InputError(figures[0], f"subject {name}: {figures[1]}")
    return {**_worst(list(people.values())), "subjects": people}


def _begin(threads: int) -> None:
    """Prepare a process of the pool."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(process)d %(message)s")
    numba.set_num_threads(min(threads, numba.get_num_threads()))
    threadpool_limits(1, user_api="blas")


def _safely(job: Job) -> Figures | tuple[str, str]:
    """Return a subject's figures, or code and message of what is wrong with the input."""
    try:
        return _subject(*job)
    except InputError as fault:
        return fault.code, fault.message


def _worst(people: list[Figures]) -> Figures:
    """Return the figures of the worst subject, each by itself; None where no subject has one."""
    found: Figures = {}
    for key, choose in WORST.items():
        values = [person[key] for person in people if person[key] is not None]
        found[key] = choose(values) if values else None
    return found


def _subject(
    name: str, model: SubjectModel, captures: CaptureSet, options: argparse.Namespace
) -> Figures:
    if not captures.train:
        raise InputError("captures.empty", "the capture sets have no training expression")
    log.info("%s: %d vertices, %d tets", name, len(model.rest), len(model.tets))
    face = Face(model)
    schedule = GeometryOptions(rounds=QUICK_ROUNDS) if options.quick else GeometryOptions()
    S, train = subject_fits.by_geometry(face, captures.train, schedule)
    _tell(name, "training scans", train)
    test = subject_fits.by_activations(face.with_weights(S), captures.test)
    _tell(name, "test scans", test)
    alone = subject_fits.by_activations(face, captures.train)
    _tell(name, "training scans, geometric S", alone)
    few = _few_scans(face, captures, schedule)
    _tell(name, "test scans, S of three scans", few)
    tets = Face(model, material=COROTATED_DET)
    stop = PerTetOptions(max_iterations=10) if options.quick else PerTetOptions()
    by_tets = subject_fits.by_tets(tets, captures.train, stop)
    _tell(name, "training scans, P", by_tets)
    bump = _bump(name, captures, test, tets, stop) if captures.test else {}
    if options.pictures is not None:
        _pictures(options.pictures / f"fit_quality-{name}.png", name, train, by_tets)
    expressions = {**train.figures("train"), **test.figures("test")}
    crossings = [figures["lip_crossing_mm"] for figures in expressions.values()]
    ratio = alone.mean_mm / train.mean_mm if alone.mean_mm and train.mean_mm else None
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "muscles": model.muscle_count,
        "train_mean_mm": train.mean_mm,
        "test_mean_mm": test.mean_mm,
        "inverted": train.inverted() + test.inverted(),
        "lip_crossing_max_mm": max((c for c in crossings if c is not None), default=None),
        "ablation_mean_mm": alone.mean_mm,
        "ablation_ratio": ratio,
        "three_scans_test_mean_mm": few.mean_mm,
        "followed_S": bump.get("S"),
        "followed_P": bump.get("P"),
        "per_tet_train_mean_mm": by_tets.mean_mm,
        "per_tet_inverted": by_tets.inverted(),
        "failed": {**train.failed, **test.failed},
        "per_tet_failed": by_tets.failed,
        "seconds": {
            "geometry": train.seconds,
            "test": test.seconds,
            "ablation": alone.seconds,
            "three_scans": few.seconds,
            "per_tet": by_tets.seconds,
        },
        "expressions": expressions,
        "per_tet_expressions": by_tets.figures("train"),
    }


def _tell(name: str, what: str, fits: Fits) -> None:
    log.info("%s: %s: %s mm in %.0f s", name, what, fits.mean_mm, fits.seconds)


def _few_scans(face: Face, captures: CaptureSet, schedule: GeometryOptions) -> Fits:
    """Return the test scans by an S of the first training scans; none if there are no more."""
    if len(captures.train) <= FEW_SCANS:
        return Fits(face, {}, {}, 0.0, {})
    S, _ = subject_fits.by_geometry(face, captures.first(FEW_SCANS, 0).train, schedule)
    return subject_fits.by_activations(face.with_weights(S), captures.test)


def _bump(
    name: str, captures: CaptureSet, test: Fits, tets: Face, stop: PerTetOptions
) -> dict[str, float]:
    """Return what part of a bump on a test scan's cheek is followed by S and by P.

    It is the scan whose cheek is the calmest, so that what is followed is the bump: where flesh
    folds, two fits by P differ by more than that.
    """
    place = cheek(tets.model)
    _, there = add_bump(captures.neutral, place)

    def motion(name: str) -> float:
        away = captures.test[name].vertices - captures.neutral.vertices
        return float(np.linalg.norm(away[there.vertices], axis=1).mean())

    expression = min(captures.test, key=motion)
    scan = captures.test[expression]
    spoilt, bump = add_bump(scan, place)
    found = {}
    pairs = {
        "S": (test, subject_fits.by_activations(test.face, {expression: spoilt})),
        "P": tuple(subject_fits.by_tets(tets, {expression: s}, stop) for s in (scan, spoilt)),
    }
    for key, (without, with_bump) in pairs.items():
        if expression in without.states and expression in with_bump.states:
            found[key] = followed(bump, without.skin(expression), with_bump.skin(expression))
    log.info("%s: bump on %s followed: %s", name, expression, found)
    return found


def _pictures(path: Path, name: str, train: Fits, by_tets: Fits) -> None:
    """Draw scan, S and P of every training expression that both could fit."""
    rows = {
        expression: Compared(
            train.scans[expression].vertices,
            {"S": train.states[expression], "P": by_tets.states[expression]},
        )
        for expression in train.states
        if expression in by_tets.states
    }
    if rows:
        pictures.side_by_side(path, train.face, f"Subject {name}", rows)


def section(figures: Figures) -> Section:
    """Return the document's section."""
    people: dict[str, Figures] = figures["subjects"]
    rows = [[name, *(person[key] for key in COLUMNS)] for name, person in people.items()]
    names = [
        name
        for name in next(iter(people.values()))["expressions"]
        if all(name in person["expressions"] for person in people.values())
    ]
    details = [
        [subject, name, found["role"], *(found[key] for key in DETAILS)]
        for subject, person in people.items()
        for name, found in person["expressions"].items()
    ]
    plot = documents.IMAGES / "fit_quality-errors.png"
    means = {
        subject: [person["expressions"][name]["mean_mm"] for name in names]
        for subject, person in people.items()
    }
    plots.bars(plot, "Mean distance to the scan", "mm", names, means)
    return Section(
        title="Fit quality",
        compared=(
            "Fitted faces against the scans they were fitted to, vertex by vertex over the face "
            "skin. S is fitted to the training scans; the unseen ones are fitted by activations "
            "and jaw alone. For comparison: the training scans by activations with the geometric "
            "S of the model, and by the per-tet model P; the unseen scans with an S of the first "
            "three training scans; and how much of a bump of 6 mm on the cheek of an unseen scan, "
            "which no face can make, each model follows."
        ),
        parts=[
            Table(["subject", *COLUMNS.values()], rows),
            Plot(plot, "Mean distance to the scan of every expression"),
            Table(["subject", "expression", "role", *DETAILS.values()], details),
        ],
    )


if __name__ == "__main__":
    main()
