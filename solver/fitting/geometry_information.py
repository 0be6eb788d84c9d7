"""Information of scans on a person's muscle geometry S, and the gain of one more expression.

S has a number for every muscle near a tet. Scans determine less: how much of the flesh a muscle
fills, and where it fills more. So S = S_0 + sum_l theta_l B_l, with a constant and
three slopes for every muscle, and theta ~ N(0, weight_sd^2). Linearised at an expression's state,
the face's points move by X theta + Z dp, where p = (a, b) is the pose, which is not known either.
With the noise's precision W and the pose's prior precision R, eliminating dp leaves

    I = X^T (W - W Z (Z^T W Z + R)^-1 Z^T W) X,

the matrix of :mod:`solver.fitting.joint` in few unknowns. It is the information that a scan of the
expression adds, (P + sum_k I_k)^-1 being the posterior of theta after scans k, and at once what an
error of theta costs there. With g = X^T (...) r of what a fit leaves, r, in the same projection,

    d^2(theta) = d^2(0) - 2 g . theta + theta . I theta

is the least squared distance to the expression by another S (:class:`Misfit`). A scan e takes S one
Gauss-Newton step on, theta_e = (P + sum_k I_k + I_e)^-1 g_e; its gain is by how much that lowers d
over a library of expressions. The information about S alone, tr I_e C, says little of that gain:
there is much in S that no expression needs.

Conditioned on the template's fibres and muscles near each tet, on the law, and on the states it is
linearised at; S within a muscle finer than its slopes counts as known. Distances that no S could
explain are part of the noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting.face import Face, PosedFace
from solver.fitting.information import Posterior
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics.response import SparseControls
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class InformationOptions:
    """Noise of a scan, and spreads of S and of a pose before any."""

    noise_mm: float = 0.5  # of a coordinate of a scan's point, registration and law included
    # errors of a scan are smooth: so many of its points err independently
    independent: float = 200.0
    weight_sd: float = 0.1  # of S, which is a fraction of a tet's volume
    # so far S goes for one more scan: with it the gains of 120 fits are predicted best
    step_sd: float = 0.03
    activation_sd: float = 0.3  # of an entry of an activation, around that of the fit
    jaw_sd_mm: float = 5.0  # of the jaw's motion at the chin


@dataclass(frozen=True)
class WeightModes:
    """The changes of S that count: ``matrix`` (nnz, 4 m) B, and each muscle's ``places`` (m, 4)."""

    matrix: sp.csr_array
    places: Ints

    @classmethod
    def of(cls, face: Face) -> WeightModes:
        """Return a constant and three slopes of every muscle of S, each of unit mean square."""
        S = face.S
        model = face.model
        tets = np.repeat(np.arange(S.shape[0]), np.diff(S.indptr))
        passive = np.full(S.shape[0], -1)
        passive[tets[S.indices == 0]] = np.flatnonzero(S.indices == 0)
        centres = model.rest[model.tets].mean(axis=1)
        muscles = S.shape[1] - 1
        rows = []
        columns = []
        values = []
        for muscle in range(muscles):
            entries = np.flatnonzero(S.indices == muscle + 1)
            own = tets[entries]
            if not len(own):
                continue
            shapes = _shapes(centres[own], face.flesh.volumes[own])
            for number, shape in enumerate(shapes.T):
                # what a muscle gains passive flesh loses, where there is any
                rest = passive[own]
                rows += [entries, rest[rest >= 0]]
                columns += [np.full(len(own) + (rest >= 0).sum(), 4 * muscle + number)]
                values += [shape, -shape[rest >= 0]]
        size = S.nnz, 4 * muscles
        if not rows:
            return cls(sp.csr_array(size), np.arange(4 * muscles).reshape(-1, 4))
        found = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return cls(sp.csr_array(found, shape=size), np.arange(4 * muscles).reshape(-1, 4))


def _shapes(centres: Floats, volumes: Floats) -> Floats:
    """Return 1 and the coordinates along the principal axes (k, 4), of unit mean square."""
    share = volumes / volumes.sum()
    away = centres - share @ centres
    _, axes = np.linalg.eigh(away.T @ (share[:, None] * away))
    along = away @ axes
    scale = np.sqrt(share @ along**2)
    # a muscle in one tet, or in one plane, has no slope there
    flat = scale <= 1e-6 * max(scale.max(), 1.0)
    slopes = np.divide(along, scale, out=np.zeros_like(along), where=~flat)
    return np.column_stack([np.ones(len(along)), slopes])


def pose_precision(face: Face, options: InformationOptions = InformationOptions()) -> Floats:
    """Return the precision (size, size) of a pose whose entries are independent."""
    layout = face.layout
    by_muscle = np.full(layout.drive.rest.shape, options.activation_sd**-2)
    by_joint = (layout.joint_units / options.jaw_sd_mm) ** 2
    return np.diag(layout.join([by_muscle, by_joint]))


@dataclass(frozen=True)
class Misfit:
    """The least weighted squared distance d^2 to an expression, as it goes with theta (n,)."""

    information: Floats  # I (n, n)
    slope: Floats  # g (n,)
    squared: float  # at theta = 0

    def at(self, theta: Floats) -> float:
        """Return d^2 by another S; the linear model makes it no less than 0."""
        found = self.squared - 2.0 * self.slope @ theta + theta @ self.information @ theta
        return max(float(found), 0.0)

    def after(self, theta: Floats) -> Misfit:
        """Return the misfit as counted from ``theta``."""
        return Misfit(self.information, self.slope - self.information @ theta, self.at(theta))


class Linearisation:
    """Makes the matrices I (4 m, 4 m) of states of one face, in ``modes`` of its S.

    ``precision`` is the prior's of a pose; without it that of :func:`pose_precision`.
    """

    def __init__(
        self,
        face: Face,
        precision: Floats | None = None,
        options: InformationOptions = InformationOptions(),
    ) -> None:
        self.face = face
        self.options = options
        self.modes = WeightModes.of(face)
        self._precision = pose_precision(face, options) if precision is None else precision

    def information(self, state: PosedFace, weights: Floats | None = None) -> Floats:
        """Return I of one state, as :meth:`misfit`."""
        return self.misfit(state, self.face.face_points(state.x), weights).information

    def misfit(self, state: PosedFace, points: Floats, weights: Floats | None = None) -> Misfit:
        """Return the misfit of ``points`` (k, 3) that ``state`` was fitted to.

        ``weights`` (k,) are of the points, none of 0 is seen. Raises :class:`SolveError`
        (``solve.not_finite``) where the state is no equilibrium that has derivatives.
        """
        face = self.face
        sensitivity = Sensitivity(self.face, state)
        weights = np.ones(len(face.model.face)) if weights is None else weights
        seen = np.flatnonzero(weights > 0.0)
        forces = sp.csc_array(sensitivity.weights.matrix() @ self.modes.matrix)
        held = sp.csr_array((state.x.size, forces.shape[1]))
        by_weights = sensitivity.response.motions(SparseControls(forces, held))
        by_pose = sensitivity.response.motions(sensitivity.pose)
        share = np.sqrt(weights[seen] / weights.sum() * self.options.independent)
        share /= self.options.noise_mm
        root = sp.diags_array(share) @ face.face_embedding[seen]
        X, Z = (
            np.asarray(root @ by.reshape(len(by), -1)).reshape(3 * len(seen), -1)
            for by in (by_weights, by_pose)
        )
        left = share[:, None] * (points[seen] - face.face_points(state.x)[seen])
        rows = np.column_stack([X, left.ravel()])
        coupling = Z.T @ rows
        known = Z.T @ Z + self._precision
        try:
            pose = scipy.linalg.solve(known, coupling, assume_a="pos")
        except (np.linalg.LinAlgError, ValueError) as error:
            message = f"no information of a state: {error}"
            raise SolveError("solve.not_finite", message) from error
        found = rows.T @ rows - coupling.T @ pose
        found = 0.5 * (found + found.T)
        return Misfit(found[:-1, :-1], found[:-1, -1], float(found[-1, -1]))

    def posterior(self, scanned: Sequence[Floats], weight_sd: float | None = None) -> Posterior:
        """Return the posterior of theta after scans of the matrices ``scanned``.

        ``weight_sd`` stands in for that of the options.
        """
        size = self.modes.matrix.shape[1]
        sd = weight_sd or self.options.weight_sd
        prior = np.eye(size) / sd**2
        return Posterior.of_normal(sum(scanned, np.zeros((size, size))), prior)

    def error_mm(self, misfits: Iterable[Misfit], theta: Floats) -> float:
        """Return the mean over expressions of their rms distance, mm, by another S."""
        unit = self.options.noise_mm * self.options.independent**-0.5
        return float(np.mean([unit * np.sqrt(misfit.at(theta)) for misfit in misfits]))


@dataclass(frozen=True)
class MuscleInformation:
    """Information (m,) in [0, 1] of scans on each muscle's part of S, and pairs they confuse.

    ``confused`` are numbers of muscles and the correlation of how much flesh they fill: near -1 the
    scans determine what both do together, and not which of them does it.
    """

    information: Floats
    confused: tuple[tuple[int, int, float], ...]
    scans: int

    @classmethod
    def of(cls, posterior: Posterior, places: Ints, scans: int) -> MuscleInformation:
        """Read it from a posterior of theta; ``places`` (m, 4) are the muscles'."""
        size = places[:, 0]
        constant = Posterior(
            posterior.covariance[np.ix_(size, size)], posterior.prior_variance[size]
        )
        information = posterior.information_of(places)
        return cls(information, tuple(constant.correlated_pairs()), scans)


@dataclass(frozen=True)
class Proposal:
    """An expression to scan, and the expected rms error, mm, over the library before and after."""

    name: str
    before_mm: float
    after_mm: float

    @property
    def gain_mm(self) -> float:
        """Return by how much the expected error falls."""
        return self.before_mm - self.after_mm


def step_towards(posterior: Posterior, misfit: Misfit) -> Floats:
    """Return theta (n,) of the Gauss-Newton step that one more scan takes S, by its ``misfit``."""
    return np.asarray(posterior.after(misfit.information).covariance @ misfit.slope)


def rank(
    linearisation: Linearisation, posterior: Posterior, library: Mapping[str, Misfit]
) -> list[Proposal]:
    """Rank a ``library`` by the gain of a scan of each after ``posterior``, best first.

    The error is that over the whole library, the expression itself included.
    """
    misfits = [*library.values()]
    before = linearisation.error_mm(misfits, np.zeros(len(posterior.covariance)))
    found = []
    for name, misfit in library.items():
        after = linearisation.error_mm(misfits, step_towards(posterior, misfit))
        found.append(Proposal(name, before, after))
    return sorted(found, key=lambda proposal: proposal.after_mm)
