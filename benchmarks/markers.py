"""Fits of markers against the whole face that made them, and against fits of all its points.

Takes are made of a recorded performance (:mod:`benchmarks.made_takes`), and real. ``face_mean_mm``
is over all points of the face, as a scan of the frame would have them. Fits stay within the rig's
limits, as those of jobs do, unless ``--controls free`` lifts them.

Figures by key: ``sets.K.clean`` and ``.degraded`` for K markers with their places mended by the
take, as jobs do; ``as_bound`` without that, ``scans_prior`` without the template's shapes;
``head``; ``jaw`` free and on its tracks; ``held`` (a cheek's markers gone for a second);
``calibration`` (how often the truth is within the stated spread, in poses of the model's own);
``dense`` (all points, the same frames); ``speed``; ``live`` with a preview; ``real`` takes.
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import report, subject_fits, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.held import measure_held
from benchmarks.made_takes import FRAMES, QUICK_FRAMES, REFINING, Bench, Truth, make_truth, rms
from benchmarks.speed.clock import Stopwatch
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.anatomy.build import build_subject_model, jaw_tracks
from solver.anatomy.meshing import find_or_make_mesh
from solver.errors import SolveError
from solver.fitting import prior
from solver.fitting.activation import unseen_regulariser
from solver.fitting.controls import jaw_on_tracks
from solver.fitting.expression_basis import ExpressionBasis
from solver.fitting.face import Face
from solver.fitting.markers.filter import KnownControls
from solver.fitting.markers.observation import Markers, SeenMarkers
from solver.fitting.markers.places import refine_by_take
from solver.fitting.markers.term import MarkerPlaces
from solver.fitting.prior import GaussianPrior
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DensePoints, SeenPoints
from solver.jobs.build_preview import TOLERANCE
from solver.live.markers import LiveMarkers
from solver.mechanics.linear import fastest
from solver.rig import Rig
from solver.rig.preview import make_live_preview
from solver.scans.live_link import read_live_link
from solver.scans.markers.places.marker_set import BoundTake, MarkerSet
from solver.scans.markers.prepare import bind
from solver.scans.markers.readers.take import read_take
from solver.similarity import IDENTITY
from solver.surface import Floats
from solver.templates.ict_facekit import FaceKit, drive, ict_neutral, read_facekit
from solver.templates.ict_template import build_ict_template

SETS = (79, 40, 17)
PARTS = ("sets", "head", "jaw", "held", "calibration", "live", "real")
HEAD_MARKERS = 4
DRAWS = 12  # poses that are drawn from the prior
DRAWN = 0.7  # their size, by the prior's own
LIVE_SECONDS = 600.0
REAL_TAKES = ("jaw", "nose")
REAL_STEP = 6
LEFT_OUT_FRAMES = 10

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    subjects.add_controls(parser)
    parser.add_argument("--recording", type=Path, help="Live Link Face recording")
    parser.add_argument("--takes", type=Path, help="folder of real takes")
    parser.add_argument("--rig", type=Path, help="the subject's rig; else it is fitted first")
    parser.add_argument("--frames", type=int, help="of each take")
    parser.add_argument("--sets", default=",".join(map(str, SETS)), help="numbers of markers")
    subjects.default_to_data(parser)
    report.add_list(parser, "--parts", PARTS)
    parser.add_argument("--first", type=int, help="frame of the recording to begin with")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Measure everything and return the figures."""
    frames = options.frames or (QUICK_FRAMES if options.quick else FRAMES)
    parts = options.parts
    rig = subject_fits.given_rig(options)
    face = rig.face(fastest())
    kit = read_facekit(options.faces)
    neutral = ict_neutral(kit, options.faces, options.subject, options.capture_sets)
    shapes = np.stack([*kit.deltas.values()])
    performance = drive(kit, neutral.vertices, read_live_link(options.recording))
    truth = make_truth(performance, frames, options.first)
    basis = ExpressionBasis.solve(face, shapes)
    known = prior.from_basis(face, basis)
    counts = [int(count) for count in options.sets.split(",")]
    found: Figures = {
        "tets": len(rig.model.tets),
        "frames": len(truth.numbers),
        "controls": "free" if rig.limits is None else "admissible",
    }

    def add(name: str, figures: Figures) -> None:
        log.info("%s: %s", name, figures)
        found[name] = figures

    if "sets" in parts:
        by_scans = prior.from_expressions(
            face, [face.pose_of(each.activations, each.jaw) for each in rig.expressions]
        )
        add("dense", _dense(face, truth))
        found["sets"] = {
            str(count): _of_set(Bench(face, truth, count), known, by_scans) for count in counts
        }
        most = found["sets"][str(counts[0])]
        add("degraded", {**most["degraded"].pop("wrong"), **most["degraded"]})
        milliseconds = most["clean"]["frame_ms"]
        over = milliseconds / found["dense"]["frame_ms"]
        add("speed", {"frame_ms": milliseconds, "over_dense": over})
        add("head", {"none": _head(most["clean"])})
    if "head" in parts:
        with_head = Bench(face, truth, SETS[0], head=HEAD_MARKERS)
        take = with_head.clean()
        four = with_head.refined(known, take).fit(known, take)
        add("head", found.get("head", {}) | {"four": _head(four), "face": four["face_mean_mm"]})
    if "jaw" in parts:
        add("jaw", _jaw(face, truth, shapes, options))
    if "held" in parts:
        add("held", measure_held(Bench(face, truth, SETS[0])))
    if "calibration" in parts:
        add("calibration", _calibration(Bench(face, truth, SETS[0]), known))
    if "live" in parts:
        add("live", _live(rig, Bench(face, truth, SETS[0]), known, basis, kit))
    if "real" in parts and options.takes is not None:
        add("real", _real(options, kit, rig, shapes))
    return found


def _head(figures: Figures) -> Figures:
    return {key: figures[f"head_{key}"] for key in ("rotation_deg", "translation_mm")}


def _of_set(bench: Bench, known: GaussianPrior, by_scans: GaussianPrior) -> Figures:
    clean = bench.clean()
    degraded = bench.degraded()
    found: Figures = {"as_bound": bench.fit(known, clean)}
    mended = bench.refined(known, clean)
    found["clean"] = mended.fit(known, clean) | {"bound_wrong_mm": mended.bound_wrong()}
    log.info("%d clean: %s", len(bench.triangles), found)
    spoilt = bench.refined(known, degraded).fit(known, degraded, watched=True)
    spoilt["over_clean"] = spoilt["face_mean_mm"] / found["clean"]["face_mean_mm"]
    found["degraded"] = spoilt
    log.info("%d degraded: %s", len(bench.triangles), spoilt)
    found["scans_prior"] = bench.refined(by_scans, clean).fit(by_scans, clean)
    log.info("%d scans: %s", len(bench.triangles), found["scans_prior"])
    return found


def _jaw(face: Face, truth: Truth, shapes: Floats, options: argparse.Namespace) -> Figures:
    """Return how far the lower incisors are off, the jaw being free and on its tracks."""
    tracks = jaw_tracks(build_ict_template(options.anatomy, options.faces), face.model)
    found = {}
    on_tracks = face.with_joint(jaw_on_tracks(tracks))
    for name, each in (("free", face.with_free_jaw()), ("tracks", on_tracks)):
        bench = Bench(each, truth, SETS[0])
        known = prior.from_basis(each, ExpressionBasis.solve(each, shapes))
        take = bench.clean()
        fitted = bench.refined(known, take).fit(known, take)
        keys = ("incisor_mm", "out_of_tracks", "face_mean_mm", "frame_ms")
        found[name] = {key: fitted[key] for key in keys}
    return {**found, **found["tracks"]}


def _calibration(bench: Bench, known: GaussianPrior) -> Figures:
    """Return how often true controls are within 1.96 standard deviations, in the model's poses."""
    face = bench.face
    rng = np.random.default_rng(31)
    sigma = np.array([marker.sigma_mm for marker in bench.markers])
    true = bench.true_places()
    root = np.linalg.cholesky(known.covariance)
    within: list[np.ndarray] = []
    for _ in range(DRAWS):
        change = DRAWN * root @ rng.standard_normal(len(root))
        tracker = Tracker(Markers(face, bench.places, sigma, known, bench.truth.seconds))
        try:
            state = face.continuation(face.rest, face.rest_pose().add(change))
        except SolveError:
            continue
        seen = true.at(state.x) + 0.2 * rng.standard_normal((len(bench.markers), 3))
        fit = tracker.step(SeenMarkers(seen))
        off = fit.state.pose.vector() - state.pose.vector()
        within.append(np.abs(off) <= 1.96 * fit.sd)
    return {"poses": len(within), "coverage95": float(np.mean(within))}


def _live(
    rig: Rig, bench: Bench, known: GaussianPrior, basis: ExpressionBasis, kit: FaceKit
) -> Figures:
    """Return time and error of the reduced skin at the same markers, beside the whole fit's."""
    face = bench.face
    truth = bench.truth
    take = bench.clean()
    bench = bench.refined(known, take)
    preview = make_live_preview(
        rig.face(fastest(), TOLERANCE),
        tuple(kit.deltas),
        basis,
        seed=1,
        seconds=LIVE_SECONDS,
        listen=lambda phase, done: log.debug("preview: %s %.2f", phase, done),
    )
    full = bench.fit(known, take)["face_mean_mm"]
    markers = MarkerSet(tuple(bench.markers), IDENTITY, rig.model.sha256)
    tracker = LiveMarkers(rig.model, preview.controls, preview.skin, markers)
    milliseconds = []
    errors = []
    for row, seen in enumerate(take.points):
        with Stopwatch() as clock:
            frame = tracker.step(seen, truth.seconds)
        milliseconds.append(1e3 * clock.seconds)
        skin = rig.model.skin.vertices + preview.skin.motion(frame.values)
        off = (skin - truth.skin(row))[face.model.face]
        errors.append(float(np.linalg.norm(off, axis=1).mean()))
    return {
        "frame_ms": float(np.percentile(milliseconds, 99)),
        "median_ms": float(np.median(milliseconds)),
        "model_error_mm": preview.unseen.overall()["mean"],
        "face_mean_mm": float(np.mean(errors)),
        "face_over_full": float(np.mean(errors)) / full,
    }


def _real(options: argparse.Namespace, kit: FaceKit, rig: Rig, shapes: Floats) -> Figures:
    """Return how well 40 real markers are met, on a person built from them with the rig's S."""
    with np.load(options.takes / "ict_binding.npz") as data:
        identity = data["identity"]
    neutral = kit.skin.vertices + np.tensordot(identity, kit.identities[: len(identity)], 1)
    edge = COARSE_EDGE_MM if options.quick else EDGE_MM
    template = find_or_make_mesh(build_ict_template(options.anatomy, options.faces), edge)
    model = build_subject_model(template, neutral, edge_mm=edge)
    face = replace(rig, model=model).face(fastest())
    known = prior.from_basis(face, ExpressionBasis.solve(face, shapes))
    found = {}
    for name in REAL_TAKES:
        take = read_take(options.takes / f"{name}.c3d")
        source = BoundTake(take, bind(take, model).markers, 4)
        numbers = source.frames[::REAL_STEP][: options.frames]

        def points(number: int, source: BoundTake = source) -> Floats:
            return source.frame(number).points

        frames = [points(number) for number in numbers]
        given = (points, source.frames, 1.0 / take.rate, REFINING)
        used = refine_by_take(face, source.markers, known, *given)
        sigma = np.array([each.sigma_mm for each in used])
        seconds = REAL_STEP / take.rate
        places = MarkerPlaces(model, used)
        tracker = Tracker(Markers(face, places, sigma, known, seconds))
        fits = []
        inverted = 0
        for seen in frames:
            fits.append(tracker.step(SeenMarkers(seen)).residual_mm)
            inverted += face.flesh.count_inverted(tracker.state.x)
        log.info("%s: %.3f mm", name, rms(np.concatenate(fits)[~np.isnan(np.concatenate(fits))]))
        left_out = _left_out(face, places, sigma, known, frames)
        off = np.concatenate(fits)
        found[name] = {
            "markers": len(used),
            "frames": len(frames),
            "marker_rms_mm": rms(off[np.isfinite(off)]),
            "left_out_rms_mm": rms(left_out[np.isfinite(left_out)]),
            "inverted": inverted,
        }
    return found


def _left_out(
    face: Face, places: MarkerPlaces, sigma: Floats, known: GaussianPrior, frames: list[Floats]
) -> Floats:
    """Return how far each marker (k,) is from where the others have it, in some frames."""
    rows = np.linspace(0, len(frames) - 1, LEFT_OUT_FRAMES).round().astype(int)
    off = []
    for row in rows.tolist():
        tracker = Tracker(Markers(face, places, sigma, known, 1.0))
        fit = tracker.step(SeenMarkers(frames[row]))
        assert tracker.memory is not None, "a frame was fitted"
        # from the prior alone: what came before has seen the marker
        loose = KnownControls(known.covariance, known.covariance)
        memory = replace(tracker.memory, mean=known.mean, known=loose)
        for marker in np.flatnonzero(np.isfinite(frames[row]).all(axis=1)).tolist():
            seen = frames[row].copy()
            seen[marker] = np.nan
            tracker.memory = memory
            tracker.solver.state = fit.state
            there = tracker.step(SeenMarkers(seen)).placed.points[marker]
            off.append(float(np.linalg.norm(there - frames[row][marker])))
    return np.array(off)


def _dense(face: Face, truth: Truth) -> Figures:
    """Fit all points of the face, as fit_sequence does where the head is still."""
    tracker = Tracker(DensePoints(face, unseen_regulariser(face)))
    errors = []
    milliseconds = []
    for row in range(len(truth.numbers)):
        points = truth.skin(row)[face.model.face]
        with Stopwatch() as clock:
            found = tracker.step(SeenPoints(points, np.ones(len(points))))
        if found.status == "kept":
            log.info("dense frame %d does not settle", row)
        milliseconds.append(1e3 * clock.seconds)
        off = np.linalg.norm(face.face_points(tracker.state.x) - points, axis=1)
        errors.append(float(off.mean()))
    return {"face_mean_mm": float(np.mean(errors)), "frame_ms": float(np.median(milliseconds))}


def section(figures: Figures) -> Section:
    """Return the document's section."""
    rows = [
        [
            f"{count} markers, {kind.replace('_', ' ')}",
            each["face_mean_mm"],
            each["worst_frame_mm"],
            each["head_rotation_deg"],
            each["head_translation_mm"],
            each["frame_ms"],
        ]
        for count, kinds in figures.get("sets", {}).items()
        for kind, each in kinds.items()
    ]
    header = ["take", "face, mm", "worst frame, mm", "head, deg", "head, mm", "frame, ms"]
    if dense := figures.get("dense"):
        rows.append(["all points", dense["face_mean_mm"], None, None, None, dense["frame_ms"]])
    return Section(
        title="Markers",
        compared=(
            f"{figures['frames']} frames of a recorded performance on one subject with "
            f"{figures['tets']:,} tets, seen by markers alone: the whole face that a fit makes of "
            "them against the whole face that was there, beside a fit to all points of it. Muscles "
            f"are {'within' if figures.get('controls') == 'admissible' else 'free of'} limits."
        ),
        parts=[Table(header, rows), Table(["figure", "value"], _others(figures))],
    )


def _others(figures: Figures) -> list[list[str | float]]:
    """Return the single figures of the other parts: name and value."""
    found: list[list[str | float]] = []

    def add(name: str, value: object) -> None:
        if isinstance(value, dict):
            for key, each in value.items():
                add(f"{name}.{key}", each)
        elif isinstance(value, int | float):
            found.append([f"`{name}`", value])

    for part in ("degraded", "head", "jaw", "held", "calibration", "live", "real", "speed"):
        add(part, figures.get(part))
    return found


if __name__ == "__main__":
    main()
