"""Fits of markers against the whole face that made them, and against fits of all its points.

The truth is a recorded performance on subject A of ICT-FaceKit with a turning head: never the
fitted model. Markers sit 2 mm off the skin and are bound 1 mm beside where they are; points have
white and slow noise. Degraded takes have gaps in bursts, thrown points and swapped neighbours.
``face_mean_mm`` is over all points of the face, as a scan of the frame would have them.

Figures by key: ``sets.K.clean`` and ``.degraded`` for K markers, ``scans_prior`` the same without
the template's shapes, ``head``, ``held`` (a cheek's markers gone for a second), ``dense`` (all
points, the same frames), ``speed``, and ``live`` with a rig's preview.
"""

from __future__ import annotations

import argparse
import copy
import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import report, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.speed.clock import Stopwatch
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.anatomy.warp import spread
from solver.contact.crossing import crossing
from solver.contact.mouth import Mouth
from solver.errors import SolveError
from solver.fitting import geometry, prior
from solver.fitting.activation import unseen_regulariser
from solver.fitting.contact import terms
from solver.fitting.face import Face, Pose
from solver.fitting.markers.places import refine
from solver.fitting.markers.term import MarkerPlaces
from solver.fitting.markers.tracker import MarkerTracker
from solver.fitting.objective import Target, distances
from solver.fitting.prior import GaussianPrior
from solver.fitting.sequence import Tracker
from solver.mechanics.linear import fastest
from solver.model import SubjectModel
from solver.rig.rig import ExpressionFit, Rig
from solver.scans.live_link import read_live_link
from solver.scans.markers.marker_set import Marker
from solver.similarity import Similarity, small_motion
from solver.surface import Floats, Ints, unit_rows
from solver.templates.ict_facekit import IctPerformance, drive, ict_neutral, read_facekit

SETS = (79, 40, 17)
FIRST_FRAME, FRAMES, QUICK_FRAMES = 2000, 900, 60
HEIGHT_MM, BOUND_WRONG_MM, SIGMA_MM = 2.0, 1.0, 1.0
WHITE_MM, SLOW_MM, SLOW_S = 0.15, 0.15, 1.0
TURN_DEG = 20.0
GONE, BURST_S = 0.05, (0.1, 0.5)
THROWN, THROWN_MM, WRONG_MM = 0.01, (5.0, 25.0), 4.0
SWAP_EVERY_S, SWAP_S = 3.0, (0.2, 1.0)
HELD_S = 1.0
REFINING = 20
HEAD_MARKERS = 4
SHARES = (0.3, 0.3, 0.4)  # of a triangle's corners in a marker on it
# how much closer markers sit in regions by parts of their names, 0 for nowhere
DENSER = {"lip": 2.0, "lid": 2.0, "chin": 1.3, "nose": 1.3, "brow": 1.3, "lining": 0.0}

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Truth:
    """What happened: skins (f, V, 3) in the head's frame, and the head's motion."""

    performance: IctPerformance
    numbers: range
    heads: list[Similarity]

    @property
    def seconds(self) -> float:
        """Return the time between frames."""
        return 1.0 / self.performance.fps

    def skin(self, row: int) -> Floats:
        """Return the skin (V, 3) of a frame without the head's motion."""
        return self.performance.frame(self.numbers[row])


@dataclass(frozen=True)
class MadeTake:
    """Points (f, k, 3) of markers as seen, which of them are wrong, and whose they are."""

    points: Floats
    wrong: np.ndarray  # (f, k) farther off than WRONG_MM
    swapped: np.ndarray  # (f, k)


def main() -> None:
    """Run from the command line."""
    data = Path(os.environ.get("MYOFACE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    parser.add_argument("--recording", type=Path, help="Live Link Face recording")
    parser.add_argument("--takes", type=Path, help="folder of real takes")
    parser.add_argument("--rig", type=Path, help="the subject's rig; else it is fitted first")
    parser.add_argument("--frames", type=int, help="of each take")
    parser.add_argument("--sets", default=",".join(map(str, SETS)), help="numbers of markers")
    if data.is_dir():
        parser.set_defaults(
            anatomy=data / "bodyparts3d",
            faces=data / "ict_facekit",
            recording=data / "performance" / "alex_rom_3.csv",
            takes=data / "markers" / "animface",
        )
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Measure everything and return the figures."""
    frames = options.frames or (QUICK_FRAMES if options.quick else FRAMES)
    rig = _rig(options)
    face = Face(rig.model, rig.weights, linear=fastest())
    kit = read_facekit(options.faces)
    neutral = ict_neutral(kit, options.faces, options.subject, options.capture_sets).vertices
    shapes = np.stack([*kit.deltas.values()])
    truth = _truth(drive(kit, neutral, read_live_link(options.recording)), frames)
    by_shapes = prior.from_shapes(face, shapes)
    poses = [Pose(each.activations, each.jaw).vector() for each in rig.expressions]
    by_scans = prior.from_changes(
        face.layout, [pose - face.layout.rest for pose in poses], prior.LOOSE
    )
    dense = _dense(face, truth)
    log.info("dense: %s", dense)
    found: Figures = {}
    for count in map(int, options.sets.split(",")):
        bench = _Bench(face, truth, count)
        clean = bench.fit(by_shapes, bench.clean())
        log.info("%d clean: %s", count, clean)
        degraded = bench.fit(by_shapes, bench.degraded())
        degraded["over_clean"] = degraded["face_mean_mm"] / clean["face_mean_mm"]
        log.info("%d degraded: %s", count, degraded)
        mended = bench.refined(by_shapes)
        refined = mended.fit(by_shapes, mended.clean())
        refined["bound_wrong_mm"] = mended.bound_wrong()
        log.info("%d refined: %s", count, refined)
        by_rig = bench.fit(by_scans, bench.clean())
        log.info("%d scans: %s", count, by_rig)
        found[str(count)] = {
            "clean": clean,
            "degraded": degraded,
            "refined": refined,
            "scans_prior": by_rig,
        }
    most = _Bench(face, truth, SETS[0])
    with_head = _Bench(face, truth, SETS[0], head=HEAD_MARKERS)
    head = with_head.fit(by_shapes, with_head.clean())
    log.info("head: %s", head)
    held = _held(most, by_shapes)
    log.info("held: %s", held)
    clean = found[str(SETS[0])]["clean"] if str(SETS[0]) in found else head
    return {
        "tets": len(rig.model.tets),
        "frames": len(truth.numbers),
        "dense": dense,
        "sets": found,
        "head": {
            "none": {key: clean[f"head_{key}"] for key in ("rotation_deg", "translation_mm")},
            "four": {key: head[f"head_{key}"] for key in ("rotation_deg", "translation_mm")},
        },
        "held": held,
        "speed": {
            "frame_ms": clean["frame_ms"],
            "over_dense": clean["frame_ms"] / dense["frame_ms"],
        },
    }


def _rig(options: argparse.Namespace) -> Rig:
    if options.rig is not None:
        return Rig.load({"rig": options.rig})
    edge = COARSE_EDGE_MM if options.quick else EDGE_MM
    model, captures = subjects.load(options, edge)
    face = Face(model)
    targets = {
        name: Target.from_points(scan.vertices[model.face]) for name, scan in captures.train.items()
    }
    fitted = geometry.fit(face, terms(face, targets), first_terms=distances(face, targets))
    expressions = []
    for name, state in fitted.states.items():
        skin, scan = face.whole_skin(state.x, state.pose.b), captures.train[name].vertices
        pose, none = state.pose, np.full(len(skin), np.nan)
        expressions.append(
            ExpressionFit(name, "train", pose.a, pose.b, skin, scan, none, 0, 0, 0.0, 0.0)
        )
    return Rig(model, fitted.S, tuple(expressions))


def _truth(performance: IctPerformance, frames: int) -> Truth:
    last = min(FIRST_FRAME + frames, len(performance))
    numbers = range(last - min(frames, last), last)
    heads = []
    for row in range(len(numbers)):
        time = row / performance.fps
        turn = np.radians(TURN_DEG) * np.array(
            [0.5 * np.sin(1.3 * time), np.sin(0.9 * time), 0.4 * np.sin(0.7 * time)]
        )
        shift = 20.0 * np.array([np.sin(0.8 * time), 0.5 * np.sin(1.1 * time), np.sin(0.5 * time)])
        heads.append(small_motion(np.concatenate([turn, shift])))
    return Truth(performance, numbers, heads)


class _Bench:
    """Takes of ``count`` markers of a truth, and what fits make of them."""

    def __init__(self, face: Face, truth: Truth, count: int, head: int = 0) -> None:
        self.face, self.truth = face, truth
        self._rng = np.random.default_rng(count)
        model = face.model
        self.triangles = marker_triangles(model, count)
        self.shares = np.tile(SHARES, (count, 1))
        self.points = self._true_points(head)
        self.markers = self._bound()
        self.places = MarkerPlaces(model, self.markers)

    def _true_points(self, head: int) -> Floats:
        """Return where the markers are (f, k, 3), with the head's motion, without noise."""
        found = []
        top = self.face.model.skin.vertices
        above = np.array([0.0, top[:, 1].max() + 10.0, 0.0])
        self.on_head = (
            above
            + 60.0
            * np.array([[1, 0, 0.5], [-1, 0, 0.5], [0.6, 0.3, -0.8], [-0.6, 0.3, -0.8]])[:head]
        )
        for row, motion in enumerate(self.truth.heads):
            skin = self.truth.skin(row)
            corners = skin[self.triangles]
            normal = unit_rows(
                np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            )
            points = np.einsum("ki,kix->kx", self.shares, corners) + HEIGHT_MM * normal
            found.append(motion(np.concatenate([points, self.on_head.reshape(-1, 3)])))
        return np.array(found)

    def _bound(self) -> list[Marker]:
        """Return the marker set: places on the skin, each BOUND_WRONG_MM beside the true one."""
        corners = self.face.model.skin.vertices[self.triangles]
        markers = []
        for number, (ids, each, share) in enumerate(
            zip(self.triangles, corners, self.shares, strict=True)
        ):
            along = unit_rows((each[1] - each[0])[None])[0]
            angle = self._rng.uniform(0.0, 2.0 * np.pi)
            normal = unit_rows(np.cross(each[1] - each[0], each[2] - each[0])[None])[0]
            step = np.cos(angle) * along + np.sin(angle) * np.cross(normal, along)
            place = share @ each + BOUND_WRONG_MM * step
            wrong = np.linalg.lstsq(np.vstack([each.T, 1e3 * np.ones(3)]), np.append(place, 1e3))[0]
            markers.append(
                Marker(
                    f"M{number}", tuple(ids.tolist()), tuple(wrong), HEIGHT_MM, sigma_mm=SIGMA_MM
                )
            )
        for number, place in enumerate(self.on_head.reshape(-1, 3)):
            at = tuple(place.tolist())
            markers.append(Marker(f"H{number}", part="head", place_mm=at, sigma_mm=0.2))
        return markers

    def refined(self, known: GaussianPrior) -> _Bench:
        """Return the bench with places mended by frames of the clean take."""
        rows = np.linspace(0, len(self.points) - 1, REFINING).round().astype(int)
        apart = len(self.points) / REFINING * self.truth.seconds
        frames = list(self.clean().points[rows])
        other = copy.copy(self)
        other.markers = list(refine(self.face, self.markers, known, frames, apart))
        other.places = MarkerPlaces(self.face.model, other.markers)
        return other

    def bound_wrong(self) -> float:
        """Return how far markers are bound beside where they are, mean in mm."""
        corners = self.face.model.skin.vertices[self.triangles]
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        true = np.einsum("ki,kix->kx", self.shares, corners)
        true += HEIGHT_MM * unit_rows(np.cross(first, second))
        off = self.places.at(self.face.model.rest)[: len(true)] - true
        return float(np.linalg.norm(off, axis=1).mean())

    def clean(self) -> MadeTake:
        """Return the take with noise alone."""
        rng = np.random.default_rng(11)
        kept = np.exp(-self.truth.seconds / SLOW_S)
        slow = np.zeros(self.points.shape)
        slow[0] = SLOW_MM * rng.standard_normal(slow[0].shape)
        for row in range(1, len(slow)):
            fresh = SLOW_MM * np.sqrt(1.0 - kept**2) * rng.standard_normal(slow[row].shape)
            slow[row] = kept * slow[row - 1] + fresh
        points = self.points + slow + WHITE_MM * rng.standard_normal(slow.shape)
        none = np.zeros(points.shape[:2], bool)
        return MadeTake(points, none, none)

    def degraded(self) -> MadeTake:
        """Return the take with gaps, thrown points and swaps as well."""
        rng = np.random.default_rng(12)
        points = self.clean().points
        frames, count = points.shape[:2]
        rate = 1.0 / self.truth.seconds
        swapped = np.zeros((frames, count), bool)
        for start in np.arange(SWAP_EVERY_S, frames / rate, SWAP_EVERY_S):
            first = int(start * rate)
            rows = slice(first, first + max(int(rng.uniform(*SWAP_S) * rate), 1))
            one = int(rng.integers(count))
            other = int(np.argsort(np.linalg.norm(self.points[0] - self.points[0][one], axis=1))[1])
            points[rows, [one, other]] = points[rows, [other, one]].copy()
            swapped[rows, one] = swapped[rows, other] = True
        thrown = (rng.uniform(size=(frames, count)) < THROWN) & ~swapped
        away = rng.uniform(*THROWN_MM, int(thrown.sum()))
        points[thrown] += away[:, None] * unit_rows(rng.standard_normal((len(away), 3)))
        gone = np.zeros((frames, count), bool)
        while gone.mean() < GONE:
            first, length = int(rng.integers(frames)), int(rng.uniform(*BURST_S) * rate)
            gone[first : first + max(length, 1), rng.integers(count)] = True
        points[gone] = np.nan
        wrong = np.linalg.norm(points - self.points, axis=2) > WRONG_MM
        return MadeTake(points, wrong & ~gone, swapped & ~gone)

    def fit(
        self,
        known: GaussianPrior,
        take: MadeTake,
        watch: Callable[[int, MarkerTracker], None] = lambda _row, _tracker: None,
    ) -> Figures:
        """Fit a take and return its figures."""
        face, truth = self.face, self.truth
        sigma = np.array([marker.sigma_mm for marker in self.markers])
        tracker = MarkerTracker(face, self.places, sigma, known, truth.seconds)
        mouth, failed = Mouth.of(face.model), 0
        errors, milliseconds, turns, shifts, lips = [], [], [], [], []
        inverted, states = 0, []
        middle = face.model.skin.vertices[face.model.face].mean(axis=0)
        for row, seen in enumerate(take.points):
            with Stopwatch() as clock:
                try:
                    fit = tracker.fit(seen)
                except SolveError as error:
                    failed += 1
                    log.info("frame %d: %s", row, error.message)
            watch(row, tracker)
            milliseconds.append(1e3 * clock.seconds)
            skin = truth.skin(row)
            state = tracker.tracker.state
            away = np.linalg.norm(face.face_points(state.x) - skin[face.model.face], axis=1)
            errors.append(float(away.mean()))
            head = fit.placed.head
            turns.append(head.then(truth.heads[row].inverse()).degrees)
            off = head(middle[None]) - truth.heads[row](middle[None])
            shifts.append(float(np.linalg.norm(off)))
            inverted += face.flesh.inverted(state.x)
            states.append(fit.judged.states)
            if mouth is not None:
                whole = face.whole_skin(state.x, state.pose.b)
                own = crossing(mouth, skin).lips
                lips.append(max(crossing(mouth, whole).lips - own, 0.0))
        found: Figures = {
            "face_mean_mm": float(np.mean(errors)),
            "worst_frame_mm": float(np.max(errors)),
            "frame_ms": float(np.median(milliseconds)),
            "head_rotation_deg": _rms(turns),
            "head_translation_mm": _rms(shifts),
            "lips_crossing_mm": float(np.max(lips, initial=0.0)),
            "inverted": inverted,
            "failed": failed,
        }
        if take.wrong.any():
            found["wrong"] = _judged(np.array(states), take)
        return found


def _judged(states: np.ndarray, take: MadeTake) -> Figures:
    """Return how well wrong points were found and swaps mended."""
    called = np.isin(states, ("outlier", "swapped"))
    true = take.wrong
    slight = take.swapped & ~true  # of neighbours nearer than what counts as wrong
    called_wrong = called & ~slight
    return {
        "recall": float((called_wrong & true).sum() / max(true.sum(), 1)),
        "precision": float((called_wrong & true).sum() / max(called_wrong.sum(), 1)),
        "swaps_repaired": float(
            (states == "swapped")[take.swapped & true].mean()
            if (take.swapped & true).any()
            else 1.0
        ),
    }


def _held(bench: _Bench, known: GaussianPrior) -> Figures:
    """Return what becomes of the left cheek without its markers for a second."""
    face, truth, take = bench.face, bench.truth, bench.clean()
    model = face.model
    places = bench.places.at(face.rest.x)
    left = places[:, 0] - np.median(places[:, 0])
    height = places[:, 1] - np.median(places[:, 1])
    cheek = (left > 15.0) & (np.abs(height) < 30.0)
    length = max(round(HELD_S / truth.seconds), 1)
    first = len(truth.numbers) // 3
    points = take.points.copy()
    points[first : first + length, cheek] = np.nan
    skins: dict[str, list[Floats]] = {"clean": [], "held": []}
    for name, each in (("clean", take.points), ("held", points)):

        def watch(_row: int, tracker: MarkerTracker, name: str = name) -> None:
            skins[name].append(face.face_points(tracker.tracker.state.x))

        bench.fit(known, MadeTake(each, take.wrong, take.swapped), watch)
    rest = model.skin.vertices[model.face]
    patch = np.linalg.norm(rest[:, None] - places[cheek], axis=2).min(axis=1) < 8.0
    rows = range(first, min(first + length, len(truth.numbers)))
    off = {
        name: np.mean(
            [
                np.linalg.norm(
                    found[row][patch] - truth.skin(row)[model.face][patch], axis=1
                ).mean()
                for row in rows
            ]
        )
        for name, found in skins.items()
    }
    after = rows.stop
    jump = 0.0
    if after < len(truth.numbers):
        steps = [
            np.linalg.norm(found[after][patch] - found[after - 1][patch], axis=1).mean()
            for found in (skins["held"], skins["clean"])
        ]
        jump = steps[0] - steps[1]
    return {
        "markers_gone": int(cheek.sum()),
        "face_over_clean": float(off["held"] / off["clean"]),
        "clean_mm": float(off["clean"]),
        "return_jump_mm": float(jump),
    }


def _dense(face: Face, truth: Truth) -> Figures:
    """Fit all points of the face, as fit_sequence does where the head is still."""
    tracker = Tracker(face, unseen_regulariser(face), face.rest)
    errors, milliseconds = [], []
    for row in range(len(truth.numbers)):
        target = Target.from_points(truth.skin(row)[face.model.face])
        with Stopwatch() as clock:
            try:
                tracker.fit(target)
            except SolveError as error:
                log.info("dense frame %d: %s", row, error.message)
        milliseconds.append(1e3 * clock.seconds)
        errors.append(float(np.nanmean(target.distances(face.face_points(tracker.state.x)))))
    return {"face_mean_mm": float(np.mean(errors)), "frame_ms": float(np.median(milliseconds))}


def marker_triangles(model: SubjectModel, count: int) -> Ints:
    """Return the triangles (k, 3) that markers sit on: far apart, closer where a face is lively.

    None lies in the mouth, where nothing can be glued. A smaller set is the start of a larger one.
    """
    lively = np.ones(len(model.skin.vertices))
    for name, ids in model.regions.items():
        for part, dense in DENSER.items():
            if part in name:
                lively[ids] = dense
    allowed = np.isin(np.arange(len(lively)), model.face) & (lively > 0.0)
    triangles = model.skin.faces[allowed[model.skin.faces].all(axis=1)]
    points = model.skin.vertices[triangles].mean(axis=1)
    tip = int(points[:, 2].argmax())
    return triangles[spread(points, count, tip, lively[triangles].mean(axis=1))]


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


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
        for count, kinds in figures["sets"].items()
        for kind, each in kinds.items()
    ]
    header = ["take", "face, mm", "worst frame, mm", "head, deg", "head, mm", "frame, ms"]
    dense = figures["dense"]
    rows.append(["all points", dense["face_mean_mm"], None, None, None, dense["frame_ms"]])
    return Section(
        title="Markers",
        compared=(
            f"{figures['frames']} frames of a recorded performance on one subject with "
            f"{figures['tets']:,} tets, seen by markers alone: the whole face that a fit makes of "
            "them against the whole face that was there, beside a fit to all points of it."
        ),
        parts=[Table(header, rows)],
    )


if __name__ == "__main__":
    main()
