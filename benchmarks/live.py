"""Live sessions against full solves of all their frames.

A recording plays on a subject at its own pace: as 79 markers with noise and a turning head, as
ARKit's weights, as all points of the skin, and as the landmarks that a detector finds of it in the
film of a near camera. Each frame that comes is followed by a session of
the library; what it sent is compared, frame by frame, with what the full solve of the same frame
makes of it afterwards. Figures by source: ``latency_ms`` of a step, ``dropped_percent`` of frames
that came before the last was ready, ``error_mm`` of the face (mean and p95 over frames),
``plain_mm`` the same without mending, ``truth_mm`` off the skin that was marked, measured or filmed
(not of weights, which have none), ``running_error_ratio`` of the told median to the true one of
the same ten seconds, ``checks_per_s``. ``--folder`` keeps what is made of the rig for other runs.
With ``--data``, a service's folder that has a rig, frames go through a service as well
(:mod:`benchmarks.live_service`): weights in ``session``, ``sessions``, ``resume`` and ``soak``, and
those of all ``--sources`` in ``sources``.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections import deque
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from benchmarks import live_service, report, subject_fits, subjects
from benchmarks.documents import Figures, Plot, Section, Table
from benchmarks.made_landmarks import FilmedLandmarks
from benchmarks.made_takes import Bench, make_truth
from solver.anatomy.template import Template
from solver.animation import shape_weights
from solver.errors import SolveError
from solver.kinds.live_messages import GivenFrame
from solver.kinds.live_session import Source
from solver.live.checks import Sample, open_solver
from solver.live.session import LiveOptions, LiveSession
from solver.photo.mesh_points import landmark_points
from solver.scans.live_link import read_live_link
from solver.scans.markers.places.marker_set import Marker, MarkerSet
from solver.similarity import IDENTITY
from solver.surface import Floats
from solver.templates.builtin.build import builtin_template
from solver.templates.ict_facekit import IctPerformance

PARTS = ("library", *live_service.PARTS)
SOURCES: tuple[Source, ...] = ("markers", "weights", "points", "landmarks")
MARKERS = 79
RATE = 60.0
SECONDS = 60.0
QUICK_SECONDS = 2.0
READY_S = 180.0  # for the process of full solves to begin
FIRST_S = 60.0  # into the recording: what is before is calm

log = logging.getLogger(__name__)


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    subjects.add_controls(parser)
    parser.add_argument("--recording", type=Path, help="Live Link Face recording")
    parser.add_argument("--builtin", action="store_true", help="the built-in person, data or not")
    parser.add_argument("--rig", type=Path, help="the subject's rig; else it is fitted first")
    parser.add_argument("--learned", type=Path, help="controls.npz of the rig")
    parser.add_argument("--folder", type=Path, help="of what is made of the rig")
    parser.add_argument("--seconds", type=float, help="of each source")
    parser.add_argument("--rate", type=float, default=RATE, help="frames a second")
    parser.add_argument("--first", type=float, default=FIRST_S, help="second to begin with")
    parser.add_argument("--pause", type=float, default=0.05, help="seconds between full solves")
    parser.add_argument("--every", type=int, default=1, help="of how many frames one is compared")
    live_service.add_options(parser)
    report.add_list(parser, "--sources", SOURCES)
    report.add_list(parser, "--parts", PARTS)
    subjects.default_to_data(parser)
    options = parser.parse_args()
    if options.builtin:
        options.faces = options.anatomy = None
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Measure all parts that are asked for and return the figures."""
    found: Figures = {}
    if "library" in options.parts:
        found |= _library(options)
    if options.data is not None:

        def recorded(rig: Path) -> _Played:
            return _Played(argparse.Namespace(**{**vars(options), "rig": rig}), rig.parent)

        found["service"] = live_service.run(options, recorded)
    return found


def _library(options: argparse.Namespace) -> Figures:
    with ExitStack() as stack:
        folder = options.folder or Path(stack.enter_context(TemporaryDirectory()))
        folder.mkdir(parents=True, exist_ok=True)
        played = _Played(options, folder)
        found: Figures = {"tets": len(played.rig.model.tets), "rate": options.rate}
        for source in options.sources:
            if frames := played.frames(source):
                found[source] = _measure(played, source, frames, options)
                log.info("%s: %s", source, found[source])
    return found


class _Played:
    """A recording on a subject, frame by frame as each source has it."""

    def __init__(self, options: argparse.Namespace, folder: Path) -> None:
        self.rig = subject_fits.given_rig(options)
        self.files = {"rig": folder / "rig.npz"}
        self.rig.save(self.files["rig"])
        template = self._template(options, folder)
        if options.learned is not None:
            self.files["controls"] = options.learned
        self.folder = folder
        shapes = template.shapes
        assert shapes is not None, "templates of benchmarks have shapes"
        take = read_live_link(options.recording)
        seconds = options.seconds or (QUICK_SECONDS if options.quick else SECONDS)
        first = min(options.first, max(float(take.times[-1]) - seconds, 0.0))
        times = first + np.arange(int(seconds * options.rate)) / options.rate
        times = times[times <= take.times[-1]]
        self.weights = live_service.between(take, times, take.weights)
        mixed = shape_weights(take, shapes.expression_names)
        even = live_service.between(take, times, mixed)
        neutral = self.rig.model.skin.vertices
        flat = shapes.expressions.reshape(len(shapes.expressions), -1).astype(float)
        performance = IctPerformance(neutral, flat, even, times - first)
        self.truth = make_truth(performance, len(times), 0)
        self.face = self.rig.face()
        self._points = landmark_points(template)

    def _template(self, options: argparse.Namespace, folder: Path) -> Template:
        if options.faces is None:
            return builtin_template()
        edge = subjects.COARSE_EDGE_MM if options.quick else subjects.EDGE_MM
        template = subjects.chosen_template(options, edge)
        self.files["template"] = folder / "template.npz"
        template.save(self.files["template"])
        return template

    def frames(self, source: Source) -> list[NDArray[np.float32]]:
        """Return the numbers of each frame; those of markers leave their set in the folder.

        There are no landmarks of a template without a detector's points.
        """
        if source == "weights":
            return [row.astype("<f4") for row in self.weights]
        moved = enumerate(self.truth.heads)
        if source == "points":
            return [head(self.truth.skin(row)).astype("<f4") for row, head in moved]
        if source == "landmarks":
            if not self._points.detected().names:
                return []
            model = self.rig.model
            film = FilmedLandmarks(self._points, model.skin.vertices[model.face].mean(axis=0))
            return [film.seen(self.truth.skin(row), head) for row, head in moved]
        bench = Bench(self.face, self.truth, MARKERS)
        markers = MarkerSet(tuple(map(_within, bench.markers)), IDENTITY, self.rig.model.sha256)
        self.files["marker_set"] = self.folder / "markers.json"
        markers.save(self.files["marker_set"])
        return [points.astype("<f4") for points in bench.clean().points]


def _within(marker: Marker) -> Marker:
    """Return a marker that was bound beside its triangle on that, as a set's file has it."""
    shares = np.clip(marker.weights, 0.0, None)
    first, second, third = (shares / shares.sum()).tolist()
    return replace(marker, weights=(first, second, third))


@dataclass
class _Run:
    """What a session made of the frames that it followed."""

    samples: list[Sample] = field(default_factory=list)
    latencies_ms: list[float] = field(default_factory=list)
    told: list[float] = field(default_factory=list)  # the running median, NaN before there is one
    dropped: int = 0
    checks: int = 0


def _measure(
    played: _Played, source: Source, frames: list[NDArray[np.float32]], options: argparse.Namespace
) -> Figures:
    """Play one source through a session, and solve all of its frames in full afterwards."""
    about = LiveOptions(source, options.rate, check_seconds=options.pause)
    session = LiveSession.open(played.files, played.folder, about, _listen)
    try:
        done = _play(session, frames, options.rate)
    finally:
        session.close()
    found: Figures = {
        "frames": len(frames),
        "latency_ms": {
            f"p{each}": float(np.percentile(done.latencies_ms, each)) for each in (50, 95, 99)
        },
        "dropped_percent": 100.0 * done.dropped / len(frames),
        "checks_per_s": done.checks * options.rate / len(frames),
    }
    log.info("%s: %s", source, found)
    pause = options.every / options.rate
    solver = open_solver(session.face, source, played.files, pause)
    truth = np.full(len(frames), np.nan)
    plain = np.full(len(frames), np.nan)
    shown = played.rig.model.face
    for sample in done.samples[:: options.every]:
        try:
            skin = solver.solve(sample)
        except SolveError:
            skin = None
        if skin is None:
            continue
        for errors, amounts in ((truth, sample.sent), (plain, sample.plain)):
            off = (session.face.skin_of(amounts) - skin)[shown]
            errors[sample.number] = np.linalg.norm(off, axis=1).mean()
    found["error_mm"] = _summary(truth[np.isfinite(truth)])
    found["plain_mm"] = float(np.nanmean(plain))
    if source != "weights":
        found["truth_mm"] = _summary(_off_truth(played, session, done.samples[:: options.every]))
    found["running_error_ratio"] = _ratio(done, truth, about.window_s * options.rate)
    return found


def _summary(errors: Floats) -> Figures:
    return {"mean": float(errors.mean()), "p95": float(np.percentile(errors, 95))}


def _off_truth(played: _Played, session: LiveSession, samples: list[Sample]) -> Floats:
    """Return how far the faces that were sent are off the true ones, both in the head's frame."""
    shown = played.rig.model.face
    off = [
        session.face.skin_of(sample.sent)[shown] - played.truth.skin(sample.number)[shown]
        for sample in samples
    ]
    return np.asarray(np.linalg.norm(off, axis=2).mean(axis=1))


def _play(session: LiveSession, frames: list[NDArray[np.float32]], rate: float) -> _Run:
    """Give a session its frames when they are due; those that are late by a frame are dropped."""
    found = _Run()
    deadline = time.monotonic() + READY_S
    while not session.is_checking and time.monotonic() < deadline:
        time.sleep(0.1)
    begin = time.perf_counter()
    for number, numbers in enumerate(frames):
        due = begin + number / rate
        wait = due - time.perf_counter()
        if wait < -1.0 / rate:
            found.dropped += 1
            continue
        time.sleep(max(wait, 0.0))
        start = time.perf_counter()
        frame = GivenFrame(number, number / rate, numbers.tobytes())
        followed, sample = session.step(frame, session.read(frame))
        found.latencies_ms.append(1e3 * (time.perf_counter() - start))
        found.samples.append(sample)
        found.told.append(followed.error_p50_mm)
    found.checks = session.errors.solved
    return found


def _ratio(done: _Run, truth: Floats, window: float) -> float | None:
    """Return the told running median over the true one, over the frames that were told any."""
    recent: deque[tuple[int, float]] = deque()
    ratios = []
    for sample, told in zip(done.samples, done.told, strict=True):
        error = truth[sample.number]
        if np.isfinite(error):
            recent.append((sample.number, float(error)))
        while recent and recent[0][0] < sample.number - window:
            recent.popleft()
        if np.isfinite(told) and recent:
            ratios.append(told / float(np.median([each for _, each in recent])))
    return float(np.mean(ratios)) if ratios else None


def _listen(phase: str, part: float) -> None:
    log.debug("%s %.2f", phase, part)


def section(figures: Figures) -> Section:
    """Return the document's section."""
    header = ["source", "p50, ms", "p95, ms", "p99, ms", "dropped, %"]
    header += ["error, mm", "p95, mm", "without mending, mm", "off the truth, mm", "told over true"]
    rows = [
        [
            source,
            *(each["latency_ms"][name] for name in ("p50", "p95", "p99")),
            each["dropped_percent"],
            each["error_mm"]["mean"],
            each["error_mm"]["p95"],
            each["plain_mm"],
            each["truth_mm"]["mean"] if "truth_mm" in each else None,
            each["running_error_ratio"],
        ]
        for source, each in figures.items()
        if source in SOURCES
    ]
    parts: list[Table | Plot | str] = []
    if rows:
        words = (
            f"On {figures['tets']:,} tets, by the library, at {figures['rate']:g} frames a second: "
            "the face that was sent against the full solve of the same frame."
        )
        parts += [words, Table(header, rows)]
    if "service" in figures:
        parts += ["Through a service.", live_service.table(figures["service"])]
    return Section(
        title="Live sessions",
        compared="A recording played at its own pace, and followed by a live session.",
        parts=parts,
    )


if __name__ == "__main__":
    main()
