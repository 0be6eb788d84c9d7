"""One subject's scans fitted for the benchmarks, by the functions and weights of the jobs."""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks import subjects
from benchmarks.documents import Figures
from solver.contact.crossing import crossing
from solver.contact.mouth import Mouth
from solver.errors import SolveError
from solver.fitting import fallback, geometry, per_tet
from solver.fitting.activation import UNSEEN_STOP, unseen_regulariser
from solver.fitting.contact import terms
from solver.fitting.drives.admissible import Admissible
from solver.fitting.drives.six_numbers import SixNumbers
from solver.fitting.face import Face, PosedFace
from solver.fitting.fallback import FallbackFit, Status
from solver.fitting.geometry import GeometryOptions
from solver.fitting.known import NOTHING_KNOWN
from solver.fitting.objective import Target, Term, distances
from solver.fitting.per_tet import PerTetOptions
from solver.fitting.recruitment import recruit
from solver.jobs.fits import describe_fit
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.rig import ExpressionFit, Rig
from solver.rig.report.certificate import with_round_trips
from solver.scans.known_activations import NOTHING, KnownMuscles
from solver.surface import Floats, Surface

log = logging.getLogger(__name__)

Scans = Mapping[str, Surface]


@dataclass(frozen=True)
class Fits:
    """Settled fits of several scans, how long they took, and why there is none of a scan.

    ``face`` is the one they are of, with its S; ``rounds`` are those that S took, in
    ``cpu_seconds`` of the processor's time.
    """

    face: Face
    scans: dict[str, Surface]
    endings: dict[str, FallbackFit]
    seconds: float
    failed: dict[str, str] = field(default_factory=dict)
    rounds: int = 0
    cpu_seconds: float = 0.0

    @property
    def states(self) -> dict[str, PosedFace]:
        """Return every expression's state."""
        return {name: ending.state for name, ending in self.endings.items()}

    @property
    def mean_mm(self) -> float | None:
        """The mean distance over expressions and face skin; None without expressions."""
        means = [self.distances(name).mean() for name in self.states]
        return float(np.mean(means)) if means else None

    def distances(self, name: str) -> Floats:
        """Return the distance (k,) mm of every vertex of the face skin."""
        points = self.face.face_points(self.states[name].x)
        goal = self.scans[name].vertices[self.face.model.face]
        return np.asarray(np.linalg.norm(points - goal, axis=1))

    def region_mean(self, name: str, regions: Sequence[str]) -> float | None:
        """Return the mean distance, mm, over some regions; None where the face has none of them."""
        model = self.face.model
        within = np.isin(model.face, np.concatenate([model.region(each) for each in regions]))
        return float(self.distances(name)[within].mean()) if within.any() else None

    def skin(self, name: str) -> Floats:
        """Return the whole skin (V, 3) of a fit."""
        state = self.states[name]
        return self.face.whole_skin(state.x, state.pose.b)

    def count_inverted(self) -> int:
        """Return the number of inverted tets in all expressions."""
        return sum(self.face.flesh.count_inverted(state.x) for state in self.states.values())

    def expressions(self, role: str) -> list[ExpressionFit]:
        """Return what a rig holds of the fits."""
        whole = np.ones(len(self.face.model.skin.vertices))
        targets = _targets(self.face, self.scans)
        share = self.seconds / max(len(self.endings), 1)
        return [
            describe_fit(
                self.face,
                name,
                role,
                RegisteredScan(self.scans[name].vertices, whole),
                targets[name],
                ending,
                share,
            )
            for name, ending in self.endings.items()
        ]

    def figures(self, role: str) -> dict[str, Figures]:
        """Return what is measured of every expression; crossings only where there is a mouth."""
        mouth = Mouth.of(self.face.model)
        found = {}
        for name, state in self.states.items():
            distance = self.distances(name)
            found[name] = {
                "role": role,
                "mean_mm": float(distance.mean()),
                "p95_mm": float(np.percentile(distance, 95)),
                "max_mm": float(distance.max()),
                "inverted": self.face.flesh.count_inverted(state.x),
                "lip_crossing_mm": mouth and crossing(mouth, self.skin(name)).lips,
                "scan_lip_crossing_mm": mouth and crossing(mouth, self.scans[name].vertices).lips,
            }
        return found


def by_geometry(face: Face, scans: Scans, schedule: GeometryOptions) -> Fits:
    """Fit S, activations and jaws to all scans; within limits the jaw is on its tracks."""
    face = face if schedule.within is None else face.with_jaw_on_tracks()
    targets = _targets(face, scans)
    rounds = 0

    def listen(number: int, states: Mapping[str, PosedFace]) -> None:
        nonlocal rounds
        rounds += 1
        log.info("round %d: %.3f mm", number, geometry.mean_error(face, targets, states))

    start = time.perf_counter()
    cpu = time.process_time()
    data = terms(face, targets)
    first_terms = distances(face, targets)
    fitted = geometry.fit(
        face,
        data,
        schedule,
        first_terms=first_terms,
        recruited=recruit(face, targets),
        listen=listen,
    )
    seconds = time.perf_counter() - start
    cpu = time.process_time() - cpu
    return Fits(fitted.face, dict(scans), fitted.endings, seconds, rounds=rounds, cpu_seconds=cpu)


def by_activations(
    face: Face, scans: Scans, known: Mapping[str, KnownMuscles] = NOTHING_KNOWN
) -> Fits:
    """Fit activations and jaw to every scan, S being known, and of some muscles what they do."""
    targets = _targets(face, scans)

    def fit(name: str, data: Term) -> FallbackFit:
        prior = unseen_regulariser(face, targets[name], known.get(name, NOTHING))
        found = fallback.fit(face, data, prior, UNSEEN_STOP)
        if found.status == "failed":
            raise SolveError("fit.failed", "; ".join(notice.message for notice in found.notices))
        return found

    return _each(face, scans, terms(face, targets), fit)


def by_tets(face: Face, scans: Scans, options: PerTetOptions) -> Fits:
    """Fit six activations per tet and the jaw to every scan; ``face`` has that model's material."""

    def fit(_name: str, data: Term) -> FallbackFit:
        found = per_tet.fit(face, data, options=options)
        status: Status = "converged" if found.status == "converged" else "stopped"
        return FallbackFit(found.state, found.objective, found.iterations, "reduced", status)

    return _each(face, scans, terms(face, _targets(face, scans)), fit)


def _each(
    face: Face, scans: Scans, data: Mapping[str, Term], fit: Callable[[str, Term], FallbackFit]
) -> Fits:
    endings = {}
    failed = {}
    start = time.perf_counter()
    for name, term in data.items():
        begin = time.perf_counter()
        try:
            endings[name] = fit(name, term)
        except SolveError as error:
            failed[name] = f"{error.code}: {error.message}"
            log.warning("%s: %s", name, failed[name])
        else:
            log.info("%s: %.1f s", name, time.perf_counter() - begin)
    return Fits(face, dict(scans), endings, time.perf_counter() - start, failed)


def _targets(face: Face, scans: Scans) -> dict[str, Target]:
    ids = face.model.face
    return {name: Target.from_points(scan.vertices[ids]) for name, scan in scans.items()}


@dataclass(frozen=True)
class Method:
    """A way to fit a subject: ``train`` shapes the face as well, ``test`` poses a shaped one.

    Controls of the muscles and the jaw may be any that its faces have; the fits' ``face`` is what
    ``test`` is given.
    """

    train: Callable[[Face, Scans, GeometryOptions], Fits]
    test: Callable[[Face, Scans], Fits]


def _by_admissible(face: Face, scans: Scans, schedule: GeometryOptions) -> Fits:
    return by_geometry(face, scans, replace(schedule, within=Admissible()))


CONTROLS = {  # by what muscles and jaw may do
    "free": Method(by_geometry, by_activations),
    "admissible": Method(_by_admissible, by_activations),
}


def rig_of(train: Fits, test: Fits) -> Rig:
    """Return the rig that the jobs would leave of both, with its round trips."""
    face = train.face
    start = time.perf_counter()
    fits = with_round_trips(face, (*train.expressions("train"), *test.expressions("test")))
    seconds = {
        "geometry": train.seconds,
        "activations": test.seconds,
        "round_trip": time.perf_counter() - start,
    }
    return Rig(face.model, face.S, fits, seconds)


def subject_rig(
    options: argparse.Namespace,
    path: Path | None,
    change: Callable[[SubjectModel], SubjectModel] = lambda model: model,
) -> Rig:
    """Return a rig file's rig.

    Where there is none S is fitted to the standard scans of the chosen subject, whose model goes
    through ``change`` first, and left there.
    """
    if path is not None and path.is_file():
        return Rig.load(path)
    edge = subjects.COARSE_EDGE_MM if options.quick else subjects.EDGE_MM
    model, captures = subjects.load(options, edge)
    schedule = subjects.schedule(options, model, quick=options.quick)
    fits = by_geometry(Face(change(model)), captures.train, schedule)
    face = fits.face
    rig = Rig(face.model, face.S, tuple(fits.expressions("train")), drive=face.drive)
    if path is not None:
        rig.save(path)
    return rig


def face_of_rig(
    options: argparse.Namespace,
    path: Path | None,
    change: Callable[[SubjectModel], SubjectModel] = lambda model: model,
) -> Face:
    """Return the face of :func:`subject_rig` with the controls of the options."""
    rig = subject_rig(options, path, change)
    return subjects.bounded(Face(rig.model, rig.weights), options)


def given_rig(options: argparse.Namespace) -> Rig:
    """Return the rig of ``options.rig``, else that of the subject's training scans, fitted now."""
    if options.rig is not None:
        rig = Rig.load({"rig": options.rig})
        return replace(rig, drive=SixNumbers()) if options.controls == "free" else rig
    edge = subjects.COARSE_EDGE_MM if options.quick else subjects.EDGE_MM
    model, captures = subjects.load(options, edge)
    schedule = subjects.schedule(options, model, quick=options.quick)
    fits = by_geometry(Face(model), captures.train, schedule)
    return Rig(model, fits.face.S, tuple(fits.expressions("train")), drive=fits.face.drive)
