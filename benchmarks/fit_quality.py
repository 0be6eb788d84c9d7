"""Distances of fitted faces to their scans, by S and by the per-tet model P, and by what muscles.

For every subject, every set of scans (``--sets``) and all controls of muscles and jaw
(``--controls``) S is fitted to the training scans and activations alone to the unseen ones, by the
functions and weights of the jobs. ``standard.free.train_mean_mm`` is then a figure of the standard
set by free muscles, of the worst subject, each figure by itself; ``subjects`` has those of each.
Distances are over the face skin, vertex by vertex, in mm. The other figures of muscles, jaw,
contact and round trip are those of the rig's certificate, the worst or the sum of all expressions
(:mod:`benchmarks.rig_figures`): ``at_bound`` are the muscles of an expression that are at a bound
of what muscles can do, ``at_fibre_bound`` at that of lengthening, ``lengthened`` those whose fibres
lengthen more than a resting muscle's may, ``closers`` those that close the jaw and contract while
it is open; ``asymmetry`` is the greatest difference of both sides' contractions, by the greatest
contraction, where the scan is alike on both; ``strayed`` the part of the worst muscle's flesh that
S has more than 5 mm outside its surface. ``round_trip.activation_error`` is how much the
activations of the unseen scans change by noise on them, ``contraction_change`` the most that a
muscle's contraction does, ``same_muscle_other_person`` the correlation of contractions in the same
expression of two subjects of ``--faces``. ``hard`` has the mean over the lips in an unseen funnel
and beam, and over the nose in a sniff, by the face that was fitted to the strong set.
``geometry_ratio`` is the processor's time of the fit of S within limits by that of the free one, if
both are in the run.

P is fitted to the training scans of each set unless ``--no-per-tet``. For the standard set and free
controls there are comparisons: ``ablation_ratio`` is the training scans' mean with activations
alone (the geometric S of the model) over that with the fitted S; ``three_scans_test_mean_mm`` the
unseen scans' mean with an S of the first three training scans; ``followed_S`` and ``followed_P``
the part of a bump that the fits follow, on the cheek of the unseen scan whose cheek is the calmest.
Subjects run side by side, as many as there are cores.
"""

from __future__ import annotations

import argparse
import logging
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numba
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks import pictures, report, subject_fits, subjects
from benchmarks.artifact import add_bump, cheek, followed
from benchmarks.documents import Figures
from benchmarks.fit_quality_section import section
from benchmarks.pictures import Compared
from benchmarks.rig_figures import (
    hard_figures,
    noise_figures,
    rig_figures,
    same_muscle_other_person,
)
from benchmarks.subject_fits import CONTROLS, Fits
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM, SETS, Subject
from solver.errors import InputError
from solver.fitting.face import Face
from solver.fitting.geometry import GeometryOptions, usual_options
from solver.fitting.per_tet import PerTetOptions
from solver.mechanics.flesh import COROTATED_DET
from solver.templates.tables import CaptureSet

QUICK_ROUNDS = 6
FEW_SCANS = 3

# how a figure is chosen among the subjects: of a set and controls, and of a set
WORST: dict[str, Any] = {
    "train_mean_mm": max,
    "test_mean_mm": max,
    "inverted": sum,
    "lip_crossing_max_mm": max,
    "beyond": max,
    "beyond_worst": max,
    "inside_out": max,
    "volume_worst_percent": max,
    "fibres_longest": max,
    "stretch_longest": max,
    "at_bound": max,
    "at_fibre_bound": max,
    "lengthened": sum,
    "asymmetry": max,
    "closers": sum,
    "strayed": max,
    "bite_max_mm": max,
    "condyle_out_mm": max,
    "jaw_beyond": max,
    "snap_max_mm": max,
    "det_least": min,
    "certificates_bad": max,
    "certificates": max,
    "round_trip": {
        "skin_mean_mm": max,
        "refit_mean_mm": max,
        "refit_activations_percent": max,
        "unreached": max,
        "activation_error": max,
        "contraction_change": max,
    },
    "hard": {"lips_mm": max, "nose_mm": max},
    "rounds": max,
    "geometry_seconds": max,
    "geometry_cpu_seconds": max,
}
WORST_OF_SET: dict[str, Any] = {
    "ablation_ratio": min,
    "three_scans_test_mean_mm": max,
    "followed_P": min,
    "followed_S": max,
    "per_tet_train_mean_mm": max,
    "per_tet_max_mm": max,
    "per_tet_inverted": sum,
    "geometry_ratio": max,
}

SUMMARY = SETS  # figures of all subjects: not those of a piece

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_folders(parser)
    parser.add_argument(
        "--subjects", type=report.list_of(), default=["A", "B", "C"], metavar="LIST"
    )
    for name, known in (("--sets", SETS), ("--controls", CONTROLS)):
        words = f"of {', '.join(known)} (default: all)"
        parser.add_argument(
            name, type=report.list_of(known), default=list(known), metavar="LIST", help=words
        )
    parser.add_argument(
        "--per-tet", action=argparse.BooleanOptionalAction, default=True, help="fit P, too: slow"
    )
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the fits by S and P")
    options = parser.parse_args()
    try:
        figures = run(options)
    except InputError as fault:
        raise SystemExit(f"{fault.code}: {fault.message}") from None
    report.finish(figures, options, section)


def run(options: argparse.Namespace) -> Figures:
    """Fit every subject and return the figures."""
    names = options.subjects[: 1 if options.quick else None]
    edge = COARSE_EDGE_MM if options.quick else EDGE_MM
    jobs = [(subject, options) for subject in subjects.each(options, names, edge)]
    cores = os.cpu_count() or 1
    workers = min(len(jobs), cores)
    with ProcessPoolExecutor(
        workers, get_context("spawn"), initializer=_begin, initargs=(cores // workers,)
    ) as pool:
        found = list(pool.map(_safely, jobs))
    people: dict[str, Figures] = {}
    for (subject, _), figures in zip(jobs, found, strict=True):
        if isinstance(figures, dict):
            people[subject.name] = figures
        else:
            raise InputError(figures[0], f"subject {subject.name}: {figures[1]}")
    return summarised({"subjects": people})


def summarised(figures: Figures) -> Figures:
    """Return figures of all ``subjects`` with those of the worst of them, by set and controls."""
    people = figures["subjects"]
    rules = {**dict.fromkeys(CONTROLS, WORST), **WORST_OF_SET}
    found = worst(list(people.values()), dict.fromkeys(SETS, rules))
    for scans, by_controls in found.items():
        for controls in CONTROLS:
            each = [p[scans][controls] for p in people.values() if controls in p.get(scans, {})]
            if each:
                by_controls[controls]["same_muscle_other_person"] = same_muscle_other_person(each)
    return {**found, "subjects": people}


def _begin(threads: int) -> None:
    """Prepare a process of the pool."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(process)d %(message)s")
    numba.set_num_threads(min(threads, numba.get_num_threads()))
    threadpool_limits(1, user_api="blas")


def _safely(job: tuple[Subject, argparse.Namespace]) -> Figures | tuple[str, str]:
    """Return a subject's figures, or code and message of what is wrong with the input."""
    try:
        return _subject(*job)
    except InputError as fault:
        return fault.code, fault.message


def worst(people: Sequence[Figures], rules: Mapping[str, Any]) -> Figures:
    """Return the figures that ``rules`` name, of the worst subject, each by itself.

    A rule chooses among the values, or has rules of its own; without a value there is no figure.
    """
    found: Figures = {}
    for key, rule in rules.items():
        values = [person[key] for person in people if person.get(key) is not None]
        if values:
            found[key] = worst(values, rule) if isinstance(rule, Mapping) else rule(values)
    return found


def _subject(subject: Subject, options: argparse.Namespace) -> Figures:
    model = subject.model
    log.info("%s: %d vertices, %d tets", subject.name, len(model.rest), len(model.tets))
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "muscles": model.muscle_count,
        **{scans: _set(subject, scans, options) for scans in options.sets},
    }


def _set(subject: Subject, scans: str, options: argparse.Namespace) -> Figures:
    """Return the figures of a set of scans by all controls, and of what they are compared with."""
    name = f"{subject.name}, {scans}"
    captures = subject.sets[scans]
    if not captures.train:
        raise InputError("captures.empty", "the capture sets have no training expression")
    face = Face(subject.model)
    schedule = usual_options(subject.model, rounds=QUICK_ROUNDS if options.quick else None)
    found: Figures = {}
    fits: dict[str, tuple[Fits, Fits]] = {}
    for controls in options.controls:
        method = CONTROLS[controls]
        train = method.train(face, captures.train, schedule)
        _tell(name, f"training scans, {controls}", train)
        test = method.test(train.face, captures.test)
        _tell(name, f"unseen scans, {controls}", test)
        fits[controls] = train, test
        found[controls] = rig_figures(train, test, subject.tracks)
        found[controls]["round_trip"] |= noise_figures(method, test)
        if scans == "strong":
            found[controls]["hard"] = hard_figures(method.test(train.face, subject.hard))
        log.info("%s: %s", name, {k: v for k, v in found[controls].items() if k in WORST})
    free = fits.get("free")
    admissible = fits.get("admissible")
    if free and admissible:
        found["geometry_ratio"] = admissible[0].cpu_seconds / free[0].cpu_seconds
    if free and scans == "standard":
        found |= _without(name, face, captures, free[0], schedule)
    if options.per_tet:
        found |= _with_tets(subject, scans, free, options)
    return found


def _tell(name: str, what: str, fits: Fits) -> None:
    log.info("%s: %s: %s mm in %.0f s", name, what, fits.mean_mm, fits.seconds)


def _without(
    name: str, face: Face, captures: CaptureSet, train: Fits, schedule: GeometryOptions
) -> Figures:
    """Return what is left without an S fitted to all training scans."""
    alone = subject_fits.by_activations(face, captures.train)
    _tell(name, "training scans, geometric S", alone)
    found: Figures = {"ablation_mean_mm": alone.mean_mm}
    if alone.mean_mm and train.mean_mm:
        found["ablation_ratio"] = alone.mean_mm / train.mean_mm
    if len(captures.train) > FEW_SCANS:
        few = subject_fits.by_geometry(face, captures.first(FEW_SCANS, 0).train, schedule)
        test = subject_fits.by_activations(few.face, captures.test)
        _tell(name, "unseen scans, S of three scans", test)
        found["three_scans_test_mean_mm"] = test.mean_mm
    return found


def _with_tets(
    subject: Subject, scans: str, free: tuple[Fits, Fits] | None, options: argparse.Namespace
) -> Figures:
    """Return the figures of P, and where there are those of S by ``free`` controls, both's."""
    name = f"{subject.name}, {scans}"
    captures = subject.sets[scans]
    tets = Face(subject.model, material=COROTATED_DET)
    stop = PerTetOptions(max_iterations=10) if options.quick else PerTetOptions()
    by_tets = subject_fits.by_tets(tets, captures.train, stop)
    _tell(name, "training scans, P", by_tets)
    expressions = by_tets.figures("train")
    found: Figures = {
        "per_tet_train_mean_mm": by_tets.mean_mm,
        "per_tet_max_mm": max((each["max_mm"] for each in expressions.values()), default=None),
        "per_tet_inverted": by_tets.count_inverted(),
        "per_tet_seconds": by_tets.seconds,
        "per_tet_failed": by_tets.failed,
        "per_tet_expressions": expressions,
    }
    if free:
        train, test = free
        if scans == "standard" and captures.test:
            found |= _bump(name, captures, test, tets, stop)
        if options.pictures is not None:
            file = options.pictures / f"fit_quality-{subject.name}-{scans}.png"
            _pictures(file, f"Subject {name}", train, by_tets)
    return found


def _bump(name: str, captures: CaptureSet, test: Fits, tets: Face, stop: PerTetOptions) -> Figures:
    """Return what part of a bump on an unseen scan's cheek is followed by S and by P.

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
    found: Figures = {}
    pairs = {
        "S": (test, subject_fits.by_activations(test.face, {expression: spoilt})),
        "P": tuple(subject_fits.by_tets(tets, {expression: s}, stop) for s in (scan, spoilt)),
    }
    for key, (without, with_bump) in pairs.items():
        if expression in without.states and expression in with_bump.states:
            found[f"followed_{key}"] = followed(
                bump, without.skin(expression), with_bump.skin(expression)
            )
    log.info("%s: bump on %s followed: %s", name, expression, found)
    return found


def _pictures(path: Path, title: str, train: Fits, by_tets: Fits) -> None:
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
        pictures.side_by_side(path, train.face, title, rows)


if __name__ == "__main__":
    main()
