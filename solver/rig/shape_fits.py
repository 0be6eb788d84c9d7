"""Expressions fitted by weights of shapes: the systems of a rig beside its muscles.

A scan is fitted by muscle tracks or by plain shapes with the same terms
(:mod:`solver.tracks.fit`), in turns with its head if that is to be placed, and kept with the
figures that muscles' fits have.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np

from solver.contact.crossing import crossing
from solver.contact.mouth import Mouth
from solver.errors import Finding, SolveError, make_warning
from solver.fitting.least_squares import LeastSquaresSolution, Listener, Termination
from solver.fitting.objective import SkinDistance, Target
from solver.fitting.tracking.dense import DenseOptions, HeadAndFace, SeenPoints
from solver.mechanics.boundary import JAW_FREEDOM
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.rig.expression import errors_on_skin
from solver.rig.round_trip import RoundTrip
from solver.rig.system import ShapeFit, place_scan
from solver.similarity import IDENTITY, Similarity
from solver.surface import Floats
from solver.tracks.fit import ShapeFace, State, TrackFitOptions, fit

TRACK_FIT = TrackFitOptions()
# a scan is fitted once, and not between frames that tell of its head as well: until that is still
SCAN_HEAD = DenseOptions(restless_mm=0.003, placings=20)


@dataclass(frozen=True)
class CrossedScanOptions:
    """Lips of a scan that cross."""

    told_mm: float = 0.5  # from this depth; closed lips of scans cross by a few tenths


def fit_scan(
    face: ShapeFace[State],
    name: str,
    scan: RegisteredScan,
    points: HeadAndFace,
    options: TrackFitOptions = TRACK_FIT,
    listen: Listener | None = None,
) -> ShapeFit:
    """Fit weights and jaw to a ``scan`` called ``name``, and go to them from rest once more.

    ``points`` makes the target of the scan's face, and places its head if it is asked to. Where the
    flesh finds no way the face stays at rest, and the fit says so.
    """
    begun = time.perf_counter()
    rest = face.rest()
    ids = face.face.model.face
    seen = SeenPoints(scan.vertices[ids], scan.confidence[ids])
    notices: tuple[Finding, ...] = ()
    if points.places_head and not points.sees(seen):
        message = "too little of the skin that lies still on the skull is seen to place the head"
        notices = (make_warning("target.no_head", message),)
        points = points.with_fixed_head()
    fitter = _ScanFitter(face, options, listen, rest)
    try:
        target, head, steps = points.fit(seen, IDENTITY, fitter.points, fitter.fit)
        found = replace(fitter.found, steps=steps)
        status = "converged" if found.termination is Termination.CONVERGED else "stopped"
    except (SolveError, np.linalg.LinAlgError) as error:
        target = points.target(seen.vertices, seen.confidence)
        head = IDENTITY
        found = LeastSquaresSolution(rest, 0.0, 0, Termination.STUCK)
        status = "failed"
        notices = (*notices, make_warning("solve.failed", f"no fit was found ({error})"))
    described = _describe(face, name, scan, _PlacedTarget(target, head), found)
    return replace(
        described,
        seconds=time.perf_counter() - begun,
        status=status,
        notices=notices,
        round_trip=_round_trip(face, rest, found.point),
    )


class _ScanFitter(Generic[State]):
    """Goes on from the last fit to targets that a head's motion changes; ``found`` is that fit."""

    def __init__(
        self, face: ShapeFace[State], options: TrackFitOptions, listen: Listener | None, rest: State
    ) -> None:
        self.found = LeastSquaresSolution(rest, 0.0, 0, Termination.STUCK)
        self._face = face
        self._options = options
        self._listen = listen

    def points(self) -> Floats:
        """Return the face's points (k, 3) as they are fitted now."""
        return self._face.face.face_points(self.found.point.x)

    def fit(self, target: Target) -> int:
        """Fit the face to a target; return the steps that were taken."""
        data = SkinDistance(self._face.face, target)
        self.found = fit(self._face, data, self.found.point, self._options, self._listen)
        return self.found.steps


@dataclass(frozen=True)
class _PlacedTarget:
    """A scan's face in the skull's axes, and the motion of its head from there."""

    target: Target
    head: Similarity


def _describe(
    face: ShapeFace[State],
    name: str,
    scan: RegisteredScan,
    placed: _PlacedTarget,
    found: LeastSquaresSolution[State],
) -> ShapeFit:
    state = found.point
    target = placed.target
    points = face.face.face_points(state.x)
    return ShapeFit(
        name,
        "test",  # no scan shapes tracks
        state.pose.activations,
        state.pose.jaw,
        face.skin(state),
        place_scan(scan.vertices, placed.head.twist),
        errors_on_skin(face.face.model, target, points),
        state.inverted,
        found.steps,
        0.0,
        target.value(points),
        state.x,
        confidence=scan.confidence,
        weights=state.q[:-JAW_FREEDOM],
        jaw_on_top=state.q[-JAW_FREEDOM:],
        lengths=state.pose.lengths,
        head=placed.head.twist,
    )


def _round_trip(face: ShapeFace[State], rest: State, found: State) -> RoundTrip:
    """Return how far the skin is off the fitted one where the controls lead to it from rest."""
    try:
        again = face.move(rest, found.q)
    except (SolveError, np.linalg.LinAlgError):
        return RoundTrip()
    ids = face.face.model.face
    return RoundTrip.between(face.skin(again)[ids], face.skin(found)[ids])


def find_crossed(
    model: SubjectModel, fit: ShapeFit, options: CrossedScanOptions = CrossedScanOptions()
) -> list[Finding]:
    """Warn of a scan whose lips go through each other, and say how far they do so in its fit."""
    mouth = Mouth.of(model)
    if mouth is None or not np.isfinite(fit.target[mouth.skin]).all():
        return []
    scanned, fitted = (crossing(mouth, skin) for skin in (fit.target, fit.skin))
    if scanned.lips < options.told_mm or scanned.vertex is None:
        return []
    left = fit.measured_error(np.array([scanned.vertex]))
    off = f", {left[0]:.1f} mm off the scan" if len(left) else ""
    message = (
        f"{fit.name}: the lips of the scan cross by {scanned.lips:.1f} mm at vertex "
        f"{scanned.vertex}; in the fit they cross by {fitted.lips:.2f} mm there{off}"
    )
    context = {"expression": fit.name, "vertex": scanned.vertex, "mm": round(scanned.lips, 2)}
    return [make_warning("target.crossed", message, context)]
