"""What a marker set tells of a person's muscles at rest, and where one more marker would help most.

The posterior of the controls after a frame of all markers, the head unknown, by the face's linear
response (:mod:`solver.fitting.information`). Candidates are points of the face; for these the head
counts as known, so that what one of them adds is a little less than said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face
from solver.fitting.information import Posterior
from solver.fitting.markers.term import MarkerPlaces, MarkerTerm
from solver.fitting.prior import GaussianPrior
from solver.fitting.sensitivity import Sensitivity
from solver.scans.markers.marker_set import Marker
from solver.surface import Floats


@dataclass(frozen=True)
class ReachOptions:
    """When a muscle counts as told, and where one more marker may be."""

    noise_mm: float = 0.2  # of a seen point, beside what its place is unsure
    known: float = 0.5  # information of a muscle that is told
    candidates: int = 200  # points of the face, evenly by their numbers
    place_mm: float = 1.0  # how sure the place of a further marker is
    count: int = 3  # further markers that are proposed
    named: int = 2  # muscles that a further marker is said to tell of


@dataclass(frozen=True)
class FurtherMarker:
    """A place for one more marker, after those before it in a list."""

    place: Floats  # (3,) on the face at rest, mm
    gain: float  # sum of the information that it adds over the controls
    muscles: tuple[int, ...]  # those that it tells most of, the first most


@dataclass(frozen=True)
class Reach:
    """Information (m,) of each muscle, in [0, 1], and what more markers would add."""

    information: Floats
    further: tuple[FurtherMarker, ...]
    options: ReachOptions

    @property
    def told(self) -> int:
        """Return how many muscles the markers tell."""
        return int((self.information > self.options.known).sum())


def reach(
    face: Face,
    markers: Sequence[Marker],
    prior: GaussianPrior,
    options: ReachOptions = ReachOptions(),
) -> Reach:
    """Return what ``markers`` tell of a face's muscles."""
    x = face.rest.x
    jacobian = Sensitivity(face, face.rest).by_pose()
    places = MarkerPlaces(face.model, markers)
    sigma = np.array([marker.sigma_mm for marker in markers])
    precision = np.tile(1.0 / (sigma**2 + options.noise_mm**2)[:, None], (1, 3))
    term = MarkerTerm(places, places.at(x), precision)
    rows = jacobian.motion(places.jacobian(x))
    normal = rows.T @ term.inner(term.place(places.at(x))) @ rows
    now = Posterior.of_normal(normal, prior.precision)
    muscles = face.layout.muscles
    information = now.information_of(muscles)
    points = face.face_points(x)
    chosen = np.unique(np.linspace(0, len(points) - 1, options.candidates).astype(int))
    at = sp.csr_array(sp.kron(face.face_embedding[chosen], sp.eye_array(3), format="csr"))
    candidates = jacobian.motion(at).reshape(len(chosen), 3, -1)
    noise = float(np.hypot(options.place_mm, options.noise_mm))
    further = []
    for number, gain in now.greedy(candidates, options.count, noise):
        seen = candidates[number] / noise
        after = now.after(seen.T @ seen)
        most = np.argsort(now.information_of(muscles) - after.information_of(muscles))
        named = tuple(most[: options.named].tolist())
        further.append(FurtherMarker(points[chosen[number]], gain, named))
        now = after
    return Reach(information, tuple(further), options)
