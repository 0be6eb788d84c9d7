"""Solve sampled frames of a live session in full beside it, in a process of their own.

A full solve is what the exact job would make of the frame: markers and points are fitted by all
muscles; where a frame says weights (or landmarks, of which there is no other fit) the flesh comes
to rest under what the muscles do at the session's values. Its distance from the skin that was sent
is the running error, and what the skin lacks is learned (:mod:`.mending`).
"""

from __future__ import annotations

import multiprocessing
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Protocol

import numpy as np
import structlog
from numpy.typing import NDArray
from typing_extensions import override

from solver.errors import InputError, SolveError
from solver.fitting import prior
from solver.fitting.activation import unseen_regulariser
from solver.fitting.markers.observation import MarkerOptions, Markers, SeenMarkers
from solver.fitting.markers.term import MarkerPlaces
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DensePoints, HeadAndFace, SeenPoints, stillness
from solver.kinds.live_session import Source
from solver.live.mending import Mend, Mender
from solver.live.rigged import LiveFace
from solver.live.samples import FILE, SolvedFrames, read_samples, sort_of, write_samples
from solver.scans.markers.places.marker_set import MarkerSet
from solver.surface import Floats

log = structlog.get_logger(__name__)

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True)
class CheckOptions:
    """How frames are solved beside a session."""

    pause_s: float = 0.1  # between two of them
    usual_s: float = 0.15  # usual time between samples, solve included
    # a sample stands for the frames within so long of it, and counts as often. The fit of a whole
    # take steps in a third of its frames alone: of samples of every tenth frame, such as count as
    # four come nearest to it (0.21 mm off, 95 %: 0.33; as nine 0.27, 0.66; as one 0.40, 0.52)
    alike_s: float = 1 / 15
    niceness: int = 10  # of their process: frames come first
    ending_s: float = 1.0  # that it gets to end: it has nothing to lose
    keeping_s: float = 60.0  # between two times that the frames which were solved are written


@dataclass(frozen=True, eq=False)
class Sample:
    """A frame that was followed: what came, and what was sent of it."""

    number: int
    numbers: NDArray[np.float32]  # (rows, width)
    values: Floats  # (s,)
    clues: Floats  # (d,)
    plain: Floats  # (r,) amounts of the skin as it is without mending
    sent: Floats  # (r,) amounts that were sent


@dataclass(frozen=True, eq=False)
class Checked:
    """A sample that was solved in full: ``error_mm`` is the face's mean distance; None: it failed.

    ``mend`` is what is known of the skin since.
    """

    number: int
    error_mm: float | None
    solve_ms: float
    mend: Mend | None = None


@dataclass(frozen=True)
class CheckOrder:
    """What the process of full solves is told: files by their roles as a job has them."""

    files: Mapping[str, Path]
    out: Path  # where the session has left the reduced skin
    source: Source
    rate: float  # frames a second that come
    options: CheckOptions
    clues: int  # of a frame
    resume: bool = False  # whether frames that an attempt before has solved are known
    left: Mapping[str, SolvedFrames] = field(default_factory=dict)  # of sessions before, by sorts


class FullSolver(Protocol):
    """Solves frames of a kind in full."""

    def solve(self, sample: Sample) -> Floats | None:
        """Return the skin (n, 3) in the head's frame; None where there is none."""


class FleshSolver(FullSolver):
    """The flesh at rest under what muscles and jaw do at the values of a frame."""

    def __init__(self, face: LiveFace) -> None:
        self._live = face
        self._state = face.face.rest

    @override
    def solve(self, sample: Sample) -> Floats | None:
        face = self._live.face
        pose = self._live.pose(sample.values)
        for start in (self._state, face.rest):
            with suppress(SolveError):
                self._state = face.continuation(start, pose)
                return face.whole_skin(self._state.x, pose.b)
        return None


class MarkerSolver(FullSolver):
    """The fit of a take's markers, by the prior of the template's expressions.

    Frames come ``seconds`` apart, and each stands for ``alike`` frames of the take about it: what
    they tell of muscles little by little one has to tell as well.
    """

    def __init__(
        self, face: LiveFace, markers: MarkerSet, seconds: float, alike: float = 1.0
    ) -> None:
        places = MarkerPlaces(face.rig.model, markers.used)
        spread = 1.0 / np.sqrt(max(alike, 1.0))
        sigma = spread * np.array([marker.sigma_mm for marker in markers.used])
        known = prior.from_basis(face.face, face.expressions)
        usual = MarkerOptions()
        options = replace(usual, noise_mm=spread * usual.noise_mm)
        self._session = markers.session
        self._tracker = Tracker(Markers(face.face, places, sigma, known, seconds, options))

    @override
    def solve(self, sample: Sample) -> Floats | None:
        found = self._tracker.step(SeenMarkers(self._session(sample.numbers.astype(float))))
        if found.kept or found.predicted:
            return None
        return self._tracker.face.whole_skin(found.state.x, found.state.pose.b)


class PointSolver(FullSolver):
    """The fit of all points of the face."""

    def __init__(self, face: LiveFace) -> None:
        self._ids = face.rig.model.face
        points = HeadAndFace(still=stillness(face.face))
        self._tracker = Tracker(DensePoints(face.face, unseen_regulariser(face.face), points))

    @override
    def solve(self, sample: Sample) -> Floats | None:
        points = sample.numbers[self._ids].astype(float)
        seen = np.isfinite(points).all(axis=1)
        found = self._tracker.step(SeenPoints(points, seen.astype(float)))
        if found.status != "fitted":
            return None
        return self._tracker.face.whole_skin(found.state.x, found.state.pose.b)


def open_sample_solver(face: LiveFace, order: CheckOrder) -> FullSolver:
    """Return what solves samples of a session as the fit of all its frames would."""
    options = order.options
    usual = max(options.pause_s, options.usual_s)
    alike = min(usual, options.alike_s) * order.rate
    return open_solver(face, order.source, order.files, usual, alike)


def open_solver(
    face: LiveFace, source: Source, files: Mapping[str, Path], seconds: float, alike: float = 1.0
) -> FullSolver:
    """Return what solves frames of a source that come ``seconds`` after each other.

    Each stands for as many ``alike`` of the take.
    """
    if source == "markers":
        markers = MarkerSet.load(files["marker_set"], face.rig.model)
        return MarkerSolver(face, markers, seconds, alike)
    return PointSolver(face) if source == "points" else FleshSolver(face)


class Checks:
    """Solves samples in full, one after another, and mends the skin by them.

    They are kept in a file, with which a session that is resumed begins, and later ones of the rig.
    """

    def __init__(self, face: LiveFace, solver: FullSolver, order: CheckOrder) -> None:
        self._face = face
        self._solver = solver
        self._mender = Mender()
        self._shown = face.rig.model.face
        self._file = order.out / FILE
        self._keeping_s = order.options.keeping_s
        self._kept = time.monotonic()
        learned = face.controls is not None
        self._sort = sort_of(face.skin, order.source, order.files, learned=learned)
        self._others = _left_samples(order)
        known = self._others.pop(self._sort, None)
        features = len(face.skin.names) + order.clues
        if known is not None and known.fits(features, len(face.skin.basis)):
            self._mender.begin(known)

    def known(self) -> Mend | None:
        """Return what is known of the skin before any frame is solved; None: nothing."""
        return self._mender.mend()

    def check(self, sample: Sample) -> Checked:
        """Solve a sample."""
        begin = time.perf_counter()
        skin = self._solver.solve(sample)
        spent = 1e3 * (time.perf_counter() - begin)
        if skin is None or not np.isfinite(skin).all():
            return Checked(sample.number, None, spent)
        off = (self._face.skin_of(sample.sent) - skin)[self._shown]
        error = float(np.linalg.norm(off, axis=1).mean())
        self._mender.add(sample.values, sample.clues, self._face.project(skin) - sample.plain)
        if time.monotonic() - self._kept > self._keeping_s:
            self.keep()
        return Checked(sample.number, error, spent, self._mender.mend())

    def keep(self) -> None:
        """Write what is known, for sessions after this one."""
        frames = self._mender.frames
        own = {} if frames is None else {self._sort: frames}
        if by_sort := {**own, **self._others}:
            write_samples(self._file, by_sort)
        self._kept = time.monotonic()


def _left_samples(order: CheckOrder) -> dict[str, SolvedFrames]:
    """Return what an attempt before has solved, else sessions before."""
    own = order.out / FILE
    if order.resume and own.is_file():
        try:
            return read_samples(own)
        except InputError as error:  # whose damage costs no session
            log.warning("samples.unreadable", file=own.name, error=error.message)
    return dict(order.left)


class CheckProcess:
    """The process of full solves, and the thread that talks to it.

    ``begin`` is called once with what is known of the skin, ``tell`` after each solve, both in that
    thread.
    """

    def __init__(
        self,
        order: CheckOrder,
        begin: Callable[[Mend | None], None],
        tell: Callable[[Checked], None],
    ) -> None:
        context = multiprocessing.get_context("spawn")
        # two pipes: a confined process may make no pair of sockets
        theirs, self._send = context.Pipe(duplex=False)
        self._receive, answer = context.Pipe(duplex=False)
        self._process = context.Process(target=_work, args=(order, theirs, answer), daemon=True)
        with _one_thread():
            self._process.start()
        theirs.close()
        answer.close()
        self._options = order.options
        self._begin = begin
        self._tell = tell
        self._orders: queue.SimpleQueue[Sample | None] = queue.SimpleQueue()
        self._is_idle = self._is_closing = False
        self._next = 0.0
        self._thread = threading.Thread(target=self._talk, daemon=True)
        self._thread.start()

    @property
    def wants_one(self) -> bool:
        """Return whether the next frame should be offered."""
        return self._is_idle and time.monotonic() >= self._next

    def offer(self, sample: Sample) -> None:
        """Have a sample solved; call it where one is wanted."""
        self._is_idle = False
        self._orders.put(sample)

    def close(self) -> None:
        """End the process."""
        self._is_closing = True
        self._is_idle = False
        self._orders.put(None)
        self._process.join(self._options.ending_s)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._thread.join(self._options.ending_s)

    def _talk(self) -> None:
        try:
            self._begin(self._receive.recv())  # it is ready
            while True:
                self._is_idle = True
                sample = self._orders.get()
                self._send.send(sample)
                if sample is None:
                    break
                begin = time.monotonic()
                self._tell(self._receive.recv())
                now = time.monotonic()
                # a pause as long as the solve: else frames just after one, when the skin is right,
                # would be sampled more than others
                self._next = now + max(self._options.pause_s, now - begin)
        except (EOFError, OSError):  # the process has died: there are no more checks
            if not self._is_closing:
                self._process.join(self._options.ending_s)
                log.warning("checks.died", exitcode=self._process.exitcode)
        self._is_idle = False


@contextmanager
def _one_thread() -> Iterator[None]:
    """Have processes that are started meanwhile use one thread: a session has frames to follow."""
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(order: CheckOrder, receive: Connection, send: Connection) -> None:
    """Solve what comes until there is no more, or the session has died."""
    with suppress(OSError):
        os.nice(order.options.niceness)
    face = LiveFace.open(order.files, order.out)
    checks = Checks(face, open_sample_solver(face, order), order)
    with suppress(EOFError, BrokenPipeError):
        send.send(checks.known())
        while (sample := receive.recv()) is not None:
            send.send(checks.check(sample))
        checks.keep()
