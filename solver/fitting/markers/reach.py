"""Find the muscles that a marker set determines at rest, and places for further markers.

The posterior of the controls after a frame of all markers, the head unknown, by the face's linear
response (:mod:`solver.fitting.information`). A muscle that lies too deep for any marker still goes
along with others in every expression that a prior knows: that counts apart, as markers determine
what they tell of a muscle by itself. Candidates are points of the face; for these the head
counts as known, which overestimates their gain a little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.fitting.face import Face
from solver.fitting.information import Posterior, inverse_of_positive
from solver.fitting.markers.term import MarkerPlaces, MarkerTerm
from solver.fitting.prior import GaussianPrior
from solver.fitting.sensitivity import Sensitivity
from solver.scans.markers.places.marker_set import Marker
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class ReachOptions:
    """Noise of markers, the information of a known muscle, and candidates for further markers."""

    noise_mm: float = 0.2  # of a seen point, beside the spread of its place
    known: float = 0.5  # information from which a muscle counts as known
    candidates: int = 200  # points of the face, evenly by their numbers
    place_mm: float = 1.0  # standard deviation of a further marker's place
    count: int = 3  # further markers that are proposed
    named: int = 2  # muscles that are named with a further marker


@dataclass(frozen=True)
class FurtherMarker:
    """A place for one more marker, after those before it in a list."""

    place: Floats  # (3,) on the face at rest, mm
    gain: float  # sum of the information that it adds over the controls
    muscles: tuple[int, ...]  # those whose information it raises most, the first most


@dataclass(frozen=True)
class Reach:
    """Information (m,) of each muscle, in [0, 1], and what more markers would add."""

    information: Floats  # by what the markers tell of the muscle itself
    by_expressions: Floats  # and by how it goes along with others in expressions
    further: tuple[FurtherMarker, ...]
    options: ReachOptions

    @property
    def known_muscles(self) -> int:
        """Return the number of muscles that the markers determine."""
        return int((self.information > self.options.known).sum())

    @property
    def following_muscles(self) -> int:
        """Return the number of the others that are known as they go along in expressions."""
        is_known = np.maximum(self.information, self.by_expressions) > self.options.known
        return int(is_known.sum()) - self.known_muscles


def reach(
    face: Face,
    markers: Sequence[Marker],
    prior: GaussianPrior,
    options: ReachOptions = ReachOptions(),
) -> Reach:
    """Return the information of ``markers`` on a face's muscles."""
    x = face.rest.x
    jacobian = Sensitivity(face, face.rest).by_pose()
    places = MarkerPlaces(face.model, markers)
    sigma = np.array([marker.sigma_mm for marker in markers])
    precision = np.tile(1.0 / (sigma**2 + options.noise_mm**2)[:, None], (1, 3))
    term = MarkerTerm(places, places.at(x), precision)
    rows = jacobian.motion(places.jacobian(x))
    normal = rows.T @ term.inner(term.place(places.at(x))) @ rows
    muscles = face.layout.muscles
    by_expressions = Posterior.of_normal(normal, prior.precision).information_of(muscles)
    apart = inverse_of_positive(_drop_correlations(prior.covariance, muscles))
    now = Posterior.of_normal(normal, apart)
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
    return Reach(information, by_expressions, tuple(further), options)


def _drop_correlations(covariance: Floats, muscles: Ints) -> Floats:
    """Return a covariance (k, k) in which no muscle (m, g) tells of another, or of the jaw."""
    group = np.full(len(covariance), -1)
    group[muscles] = np.arange(len(muscles))[:, None]
    return np.where(group[:, None] == group[None], covariance, 0.0)
