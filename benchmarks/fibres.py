"""Fibre muscles: calibrated to a person's scans, back from what they make, exaggerated, followed.

Figures by key: ``fibre`` has the mean distance to training and unseen scans of calibrated muscles,
of the template's (``uncalibrated``) and of six numbers a muscle (``blended``), and expressions with
the whole curves ``exaggerated`` 2 and 4 times: flesh in contact, the worst expression, and
``motion_ratio``, the least over the expressions of the skin's motion by muscles (the jaw's own
apart) over that at 1. ``round_trip.fibre`` are random activations, fitted again to the skin alone,
as it is and with 0.3 mm of noise on every point. ``speed`` is of frames of a take of markers; with
``--large`` also that of S in 370,000 tets.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks import made_takes, report, subject_fits, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.round_trip import fibre_round_trip
from benchmarks.speed.clock import Stopwatch
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.anatomy.build import build_subject_model
from solver.anatomy.meshing import find_or_make_mesh
from solver.contact import Gauge, contact_potentials
from solver.errors import SolveError
from solver.fitting import prior
from solver.fitting.activation import unseen_regulariser
from solver.fitting.calibration import (
    CalibrationOptions,
    calibrate,
    fibre_muscles,
    fit_all,
    load_muscles,
    save_muscles,
    with_fibres,
)
from solver.fitting.contact import terms
from solver.fitting.expression_basis import LINEAR, ExpressionBasis
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.geometry import usual_options
from solver.fitting.objective import Target, distances
from solver.fitting.strips import strip_names
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DensePoints, SeenPoints
from solver.mechanics.fibre_muscle import FibreMuscles
from solver.mechanics.flesh import MOONEY_RIVLIN
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.rig import Rig
from solver.scans.live_link import read_live_link
from solver.similarity import IDENTITY as STILL
from solver.simulation import Simulator
from solver.simulation.forces import Drive
from solver.surface import Floats, Surface
from solver.templates.builtin.build import builtin_capture_set, builtin_template
from solver.templates.ict_facekit import drive, ict_capture_set, ict_neutral, read_facekit

log = logging.getLogger(__name__)

PARTS = ("fibre", "round_trip", "exaggerated", "speed")
FACTORS = (1, 2, 4)
ROUNDS = 16
QUICK_ROUNDS = 6
FRAMES = 60
LARGE_FRAMES = 12
LARGE_EDGE_MM = 2.75  # of some 370,000 tets
LARGE_MESHER_SECONDS = 14400.0


@dataclass(frozen=True)
class Person:
    """A subject with scans, and with S if a rig was given."""

    model: SubjectModel
    train: Mapping[str, Surface]
    test: Mapping[str, Surface]
    rig: Rig | None


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    subjects.add_controls(parser)
    parser.add_argument("--rig", type=Path, help="the subject's rig; else S is fitted first")
    parser.add_argument("--muscles", type=Path, help="calibrated muscles: read if there, else left")
    parser.add_argument("--only", nargs="*", choices=PARTS, default=list(PARTS))
    parser.add_argument("--rounds", type=int, help="of the calibration")
    parser.add_argument("--exaggerated", default="smile", help="expressions, with commas between")
    parser.add_argument("--recording", type=Path, help="Live Link Face recording")
    parser.add_argument("--large", action="store_true", help="frames of 370,000 tets too")
    subjects.default_to_data(parser)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Measure what was asked for."""
    person = _person(options)
    plain = Face(person.model, material=MOONEY_RIVLIN, linear=fastest())
    rounds = options.rounds or (QUICK_ROUNDS if options.quick else ROUNDS)
    muscles, seconds = _calibrate(plain, person, rounds, options.muscles)
    face = with_fibres(plain, muscles)
    found: Figures = {
        "tets": len(person.model.tets),
        "muscles": len(muscles.strengths),
        "calibration_s": seconds,
    }
    scans = {**person.train, **person.test}
    if "fibre" in options.only:
        fits = _fits(face, scans)
        found["fibre"] = _quality(plain, person, fits)
        log.info("fibre: %s", found["fibre"])
    if "exaggerated" in options.only:
        fits = _fits(face, {name: scans[name] for name in options.exaggerated.split(",")})
        poses = {name: state.pose for name, state in fits.items()}
        found.setdefault("fibre", {})["exaggerated"] = exaggerate(person.model, muscles, poses)
    if "speed" in options.only:
        found["speed"] = _speed(face, options)
        log.info("speed: %s", found["speed"])
    if "round_trip" in options.only:
        found["round_trip"] = {
            "fibre": fibre_round_trip(face, strip_names(person.model.muscle_names, muscles))
        }
        log.info("round trip: %s", found["round_trip"])
    if options.large:
        found.setdefault("speed", {}).update(_large())
    return found


def _person(options: argparse.Namespace) -> Person:
    if options.rig is None:
        edge = COARSE_EDGE_MM if options.quick else EDGE_MM
        model, captures = subjects.load(options, edge)
        return Person(model, captures.train, captures.test, None)
    rig = Rig.load({"rig": options.rig})
    captures = ict_capture_set(options.faces, options.subject, options.capture_sets)
    return Person(rig.model, captures.train, captures.test, rig)


def _targets(model: SubjectModel, scans: Mapping[str, Surface]) -> dict[str, Target]:
    return {name: Target.from_points(scan.vertices[model.face]) for name, scan in scans.items()}


def _calibrate(
    plain: Face, person: Person, rounds: int, path: Path | None
) -> tuple[FibreMuscles, float | None]:
    """Return muscles calibrated to the training scans, and the seconds it took."""
    if path is not None and path.is_file():
        return load_muscles(path, plain), None
    targets = _targets(plain.model, person.train)

    def listen(number: int, states: Mapping[str, PosedFace]) -> None:
        off = [
            targets[name].distances(plain.face_points(state.estimate)).mean()
            for name, state in states.items()
        ]
        log.info("round %d: %.3f mm", number, np.mean(off))

    with Stopwatch() as clock:
        found = calibrate(
            plain,
            distances(plain, targets),
            CalibrationOptions(rounds=rounds),
            listen,
            ends=terms(plain, targets),
        )
    if path is not None:
        save_muscles(path, plain, found.muscles)
    return found.muscles, clock.seconds


def _fits(face: Face, scans: Mapping[str, Surface]) -> dict[str, PosedFace]:
    """Fit activations and jaw to every scan."""
    endings = fit_all(face, terms(face, _targets(face.model, scans)))
    return {name: ending.state for name, ending in endings.items()}


def _quality(plain: Face, person: Person, fits: Mapping[str, PosedFace]) -> Figures:
    """Return the distances to all scans by calibrated, the template's and blended muscles."""
    targets = _targets(plain.model, {**person.train, **person.test})
    template = _fits(with_fibres(plain, fibre_muscles(plain)), {**person.train, **person.test})
    blended = _fit_blended(person)
    by_kind = {
        "calibrated": {name: plain.face_points(state.x) for name, state in fits.items()},
        "uncalibrated": {name: plain.face_points(state.x) for name, state in template.items()},
        "blended": blended,
    }
    expressions: Figures = {}
    for name, target in targets.items():
        role = "train" if name in person.train else "test"
        errors = {
            f"{kind}_mm": float(np.nanmean(target.distances(found[name])))
            for kind, found in by_kind.items()
            if name in found
        }
        inverted = plain.flesh.count_inverted(fits[name].x)
        expressions[name] = {"role": role, **errors, "inverted": inverted}

    def mean(names: Mapping[str, Surface], kind: str) -> float | None:
        each = [expressions[name].get(f"{kind}_mm") for name in names]
        return float(np.mean(each)) if each and None not in each else None

    means = {
        kind: {"train_mm": mean(person.train, kind), "unseen_mm": mean(person.test, kind)}
        for kind in by_kind
    }
    rest = plain.face_points(plain.rest.x)
    moved = {name: float(np.nanmean(target.distances(rest))) for name, target in targets.items()}
    return {
        **means.pop("calibrated"),
        **means,
        "neutral": {
            "train_mm": float(np.mean([moved[name] for name in person.train])),
            "unseen_mm": float(np.mean([moved[name] for name in person.test])),
        },
        "expressions": expressions,
    }


def _fit_blended(person: Person) -> dict[str, Floats]:
    """Return the face's points (k, 3) of all scans as S fits them."""
    face = Face(person.model, linear=fastest())
    if person.rig is None:
        train = subject_fits.by_geometry(face, person.train, usual_options(person.model))
        face = train.face
        trained = {name: face.face_points(state.x) for name, state in train.states.items()}
    else:
        face = face.with_weights(person.rig.weights)
        ids = person.model.face
        trained = {fit.name: fit.skin[ids] for fit in person.rig.expressions}
    test = subject_fits.by_activations(face, person.test)
    return trained | {name: face.face_points(state.x) for name, state in test.states.items()}


def exaggerate(
    model: SubjectModel, muscles: FibreMuscles, poses: Mapping[str, Pose], steps: int = 5
) -> Figures:
    """Return what whole curves times 2 and 4 make of expressions, in contact."""
    plain = Face(model, material=MOONEY_RIVLIN.in_pascal(3000.0), linear=fastest())
    own = muscles.scale(plain.flesh.material.mu / MOONEY_RIVLIN.mu)
    gauge = Gauge(model)
    neutral = gauge.neutral().most
    found: dict[str, dict[str, Figures]] = {str(factor): {} for factor in FACTORS}
    for factor in FACTORS:
        face = with_fibres(plain, own.scale(float(factor)))
        for name, pose in poses.items():
            # as scenes have it: what presses harder meets what is firmer
            potentials = contact_potentials(model, factor * plain.flesh.material.mu)
            density = np.full(len(model.tets), 1e-3)
            simulator = Simulator(face, potentials, [], dynamic=False, density=density)
            found[str(factor)][name] = _play(face, simulator, gauge, pose, steps)
            log.info("x %d %s: %s", factor, name, found[str(factor)][name])
    out: Figures = {"neutral_penetration_mm": neutral, "expressions": found}
    for factor in FACTORS[1:]:
        each = found[str(factor)]
        ratios = {
            name: row["motion_mm"] / found["1"][name]["motion_mm"]
            for name, row in each.items()
            if row["motion_mm"] is not None and found["1"][name]["motion_mm"]
        }
        out[str(factor)] = {
            "inverted": sum(row["inverted"] for row in each.values()),
            "penetration_mm": max(row["penetration_mm"] for row in each.values()),
            "motion_ratio": min(ratios.values()),
            "motion_ratios": ratios,
            "failed": sum(row["failed"] for row in each.values()),
        }
    return out


def _play(face: Face, simulator: Simulator, gauge: Gauge, pose: Pose, steps: int) -> Figures:
    """Return what flesh does on its way to a pose, and where it ends."""
    drives = [
        Drive(float(number), pose.a * (number / steps), pose.b * (number / steps), STILL, ())
        for number in range(steps + 1)
    ]
    inverted = 0
    deepest = 0.0
    failed = 0
    motion = simulator.rest(drives[0])
    y = motion.head.inverse()(motion.x)
    with Stopwatch() as clock:
        for before, goal in pairwise(drives):
            try:
                stepped = simulator.step(motion, before, goal)
            except SolveError as error:
                log.info("step %g: %s", goal.time, error.message)
                failed = 1
                break
            motion = stepped.motion
            y = stepped.y
            inverted += stepped.inverted
            deepest = max(deepest, gauge.at(y, goal.jaw).most)
    rest = face.face_points(face.model.rest)
    points = face.face_points(y)
    return {
        "inverted": inverted,
        "penetration_mm": deepest,
        "motion_mm": float(np.linalg.norm(points - rest, axis=1).mean()),
        "failed": failed,
        "frame_ms": 1e3 * clock.seconds / steps,
    }


def _speed(face: Face, options: argparse.Namespace) -> Figures:
    """Follow a take of 79 markers as :mod:`benchmarks.markers` has it, by fibre muscles."""
    kit = read_facekit(options.faces)
    neutral = ict_neutral(kit, options.faces, options.subject, options.capture_sets).vertices
    take = drive(kit, neutral, read_live_link(options.recording))
    bench = made_takes.Bench(face, made_takes.make_truth(take, FRAMES), 79)
    followed = bench.fit(
        prior.from_basis(
            face, ExpressionBasis.solve(face, np.stack([*kit.deltas.values()]), LINEAR)
        ),
        bench.clean(),
    )
    return {
        "fibre_frame_ms": followed["frame_ms"],
        "fibre_face_mean_mm": followed["face_mean_mm"],
        "frames": FRAMES,
    }


def _large() -> Figures:
    """Follow the built-in person's smile in a mesh as large as that of 2005."""
    captures = builtin_capture_set()
    template = find_or_make_mesh(
        builtin_template(), LARGE_EDGE_MM, mesher_seconds=LARGE_MESHER_SECONDS
    )
    model = build_subject_model(template, captures.neutral.vertices, edge_mm=LARGE_EDGE_MM)
    log.info("large: %d tets", len(model.tets))
    face = Face(model, linear=fastest())
    tracker = Tracker(DensePoints(face, unseen_regulariser(face)))
    rest = face.face_points(face.rest.x)
    away = captures.train["smile"].vertices[model.face] - rest
    seconds = []
    errors = []
    for number in range(LARGE_FRAMES):
        points = rest + 0.05 * (number + 1) * away
        with Stopwatch() as clock:
            tracker.step(SeenPoints(points, np.ones(len(points))))
        seconds.append(clock.seconds)
        off = Target.from_points(points).distances(face.face_points(tracker.state.x))
        errors.append(float(off.mean()))
        log.info("large: frame %d, %.1f s, %.3f mm", number, seconds[-1], errors[-1])
    return {
        "large_tets": len(model.tets),
        "tets_370k_frame_s": float(np.median(seconds[1:])),
        "tets_370k_mean_frame_s": float(np.mean(seconds[1:])),
        "tets_370k_first_frame_s": seconds[0],
        "tets_370k_mean_mm": float(np.mean(errors)),
    }


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    parts = []
    fibre = figures.get("fibre", {})
    if "train_mm" in fibre:
        kinds = {"neutral face": "neutral", "template's": "uncalibrated", "six numbers": "blended"}
        rows = [
            [word, *(fibre[key][k] for k in ("train_mm", "unseen_mm"))]
            for word, key in kinds.items()
        ]
        rows.append(["calibrated", fibre["train_mm"], fibre["unseen_mm"]])
        parts.append(Table(["muscles", "training scans, mm", "unseen scans, mm"], rows))
    return Section(
        title="Fibre muscles",
        compared=f"One activation in [0, 1] a muscle, {figures['tets']:,} tets.",
        parts=parts,
    )


if __name__ == "__main__":
    main()
