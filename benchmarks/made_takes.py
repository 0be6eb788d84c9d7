"""Takes of markers made of a recorded performance, and how well fits of them do.

The truth is a recording on a subject of ICT-FaceKit with a turning head: never the fitted model.
Markers sit off the skin and are bound beside where they are; points have white and slow noise.
Degraded takes have gaps in bursts, thrown points and swapped neighbours.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.documents import Figures
from benchmarks.speed.clock import Stopwatch
from solver.anatomy.warp import spread
from solver.contact.crossing import crossing
from solver.contact.mouth import Mouth
from solver.fitting.face import Face
from solver.fitting.markers.observation import MarkerFit, Markers, SeenMarkers
from solver.fitting.markers.places import refine_by_take
from solver.fitting.markers.term import MarkerPlaces
from solver.fitting.prior import GaussianPrior
from solver.fitting.tracking import Tracker
from solver.model import SubjectModel
from solver.scans.markers.places.marker_set import Marker
from solver.similarity import Similarity, small_motion
from solver.surface import Floats, Ints, unit_rows
from solver.templates.ict_facekit import IctPerformance

FIRST_FRAME = 2000
FRAMES = 900
QUICK_FRAMES = 60
HEIGHT_MM = 2.0
BOUND_WRONG_MM = 1.0
SIGMA_MM = 1.0
WHITE_MM = 0.15
SLOW_MM = 0.15
SLOW_S = 1.0
TURN_DEG = 20.0
GONE = 0.05
BURST_S = (0.1, 0.5)
THROWN = 0.01
THROWN_MM = (5.0, 25.0)
WRONG_MM = 4.0
SWAP_EVERY_S = 3.0
SWAP_S = (0.2, 1.0)
REFINING = 20
HEAD_MARKERS = 4
SHARES = (0.3, 0.3, 0.4)  # of a triangle's corners in a marker on it
# how much closer markers sit in regions by parts of their names, 0 for nowhere
DENSER = {"lip": 2.0, "lid": 2.0, "chin": 1.3, "nose": 1.3, "brow": 1.3, "lining": 0.0}


@dataclass(frozen=True)
class Truth:
    """The true motion: skins (f, V, 3) in the head's frame, and the head's motion."""

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


def make_truth(performance: IctPerformance, frames: int, first: int | None = None) -> Truth:
    """Return so many frames of a performance, from ``first`` or the usual one, with a head."""
    last = min((FIRST_FRAME if first is None else first) + frames, len(performance))
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


class Bench:
    """Takes of ``count`` markers of a truth, and what fits make of them."""

    def __init__(self, face: Face, truth: Truth, count: int, head: int = 0) -> None:
        self.face = face
        self.truth = truth
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

    def refined(self, known: GaussianPrior, take: MadeTake) -> Bench:
        """Return the bench with places mended by frames of a take, as jobs do."""
        frame = take.points.__getitem__
        frames = range(len(take.points))
        other = copy.copy(self)
        seconds = self.truth.seconds
        other.markers = list(
            refine_by_take(self.face, self.markers, known, frame, frames, seconds, REFINING)
        )
        other.places = MarkerPlaces(self.face.model, other.markers)
        return other

    def true_places(self) -> MarkerPlaces:
        """Return the markers where they are, of a bench without markers on the head."""
        pairs = zip(self.markers, self.triangles, self.shares, strict=True)
        true = [
            replace(marker, vertices=tuple(ids.tolist()), weights=tuple(shares.tolist()))
            for marker, ids, shares in pairs
        ]
        return MarkerPlaces(self.face.model, true)

    def bound_wrong(self) -> float:
        """Return how far markers are bound beside where they are, mean in mm."""
        corners = self.face.model.skin.vertices[self.triangles]
        first = corners[:, 1] - corners[:, 0]
        second = corners[:, 2] - corners[:, 0]
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
            first = int(rng.integers(frames))
            length = int(rng.uniform(*BURST_S) * rate)
            gone[first : first + max(length, 1), rng.integers(count)] = True
        points[gone] = np.nan
        wrong = np.linalg.norm(points - self.points, axis=2) > WRONG_MM
        return MadeTake(points, wrong & ~gone, swapped & ~gone)

    def fit(
        self,
        known: GaussianPrior,
        take: MadeTake,
        watch: Callable[[int, MarkerFit], None] = lambda _row, _fit: None,
        *,
        watched: bool = False,
    ) -> Figures:
        """Fit a take and return its figures; the lips are ``watched`` only if asked for."""
        face = self.face
        truth = self.truth
        sigma = np.array([marker.sigma_mm for marker in self.markers])
        tracker = Tracker(Markers(face, self.places, sigma, known, truth.seconds))
        mouth = Mouth.of(face.model)
        failed = 0
        errors = []
        milliseconds = []
        turns = []
        shifts = []
        lips = []
        jaws = []
        inverted = 0
        not_finite = 0
        out_of_tracks = 0
        states = []
        middle = face.model.skin.vertices[face.model.face].mean(axis=0)
        incisors = incisors_of(face.model)
        for row, seen in enumerate(take.points):
            with Stopwatch() as clock:
                fit = tracker.step(SeenMarkers(seen))
            failed += fit.kept
            watch(row, fit)
            milliseconds.append(1e3 * clock.seconds)
            skin = truth.skin(row)
            pose = fit.state.pose
            away = np.linalg.norm(face.face_points(fit.state.x) - skin[face.model.face], axis=1)
            errors.append(float(away.mean()))
            head = fit.placed.head
            turns.append(head.then(truth.heads[row].inverse()).degrees)
            off = head(middle[None]) - truth.heads[row](middle[None])
            shifts.append(float(np.linalg.norm(off)))
            whole = face.whole_skin(fit.state.x, pose.b)
            jaws.append(float(np.linalg.norm((whole - skin)[incisors].mean(axis=0))))
            inverted += face.flesh.count_inverted(fit.state.x)
            not_finite += not np.isfinite(fit.state.x).all() or not np.isfinite(fit.sd).all()
            q = pose.vector()
            layout = pose.layout
            out_of_tracks += bool(
                (q < layout.lower - 1e-9).any() or (q > layout.upper + 1e-9).any()
            )
            states.append(fit.judged.states)
            if mouth is not None and watched:
                own = crossing(mouth, skin).lips
                lips.append(max(crossing(mouth, whole).lips - own, 0.0))
        found: Figures = {
            "face_mean_mm": float(np.mean(errors)),
            "worst_frame_mm": float(np.max(errors)),
            "frame_ms": float(np.median(milliseconds)),
            "head_rotation_deg": rms(turns),
            "head_translation_mm": rms(shifts),
            "lips_crossing_mm": float(np.max(lips, initial=0.0)),
            "incisor_mm": rms(jaws),
            "out_of_tracks": out_of_tracks,
            "inverted": inverted,
            "not_finite": not_finite,
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


def incisors_of(model: SubjectModel) -> Ints:
    """Return the foremost vertices (n,) of the lower teeth."""
    ids = model.lower_teeth
    ahead = model.skin.vertices[ids, 2]
    return np.asarray(ids[ahead >= np.quantile(ahead, 0.97)])


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


def rms(values: Sequence[float] | Floats) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
