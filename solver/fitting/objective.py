"""The objective of fits: the distance to the target, and the regularisers on the activations.

    f(a, b) = sum_v w_v |(M x)_v - t_v|^2 + sum_j w_a/2 |a_j - a_prior|^2
              + w_v/2 sum_j (det S(a_j) - 1)^2
              + w_b/2 |D (b - b_prior)|^2 + w_e/2 sum_jk max(0, e - lambda_k(S(a_j)))^2

w_a being one for all muscles or each one's own. Further priors are added: that both sides do alike
(:mod:`solver.fitting.recruitment`), and what a table knows of muscles
(:mod:`solver.fitting.known`).
Muscles that are no shapes S(a_j) have no volume and no stretches
(:class:`~solver.fitting.controls.ShapePenalty`).

The vertex weights sum to one, so that the first term is a mean squared distance in mm^2 and the
others do not depend on the scan's resolution (the published sums differ by that factor).
"""

from __future__ import annotations

import operator
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Protocol, TypeAlias

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from typing_extensions import override

from solver.errors import InputError
from solver.fitting.face import Face, Pose
from solver.surface import Floats, Ints


@dataclass(frozen=True)
class Target:
    """Goal of the face skin."""

    points: Floats  # (k, 3) mm
    weights: Floats  # (k,) that sum to 1
    normals: Floats | None = None  # (k, 3) of unit length: only the distance along them counts

    @classmethod
    def from_points(
        cls, points: Floats, weights: Floats | None = None, normals: Floats | None = None
    ) -> Target:
        """Normalise ``weights`` (k,), all equal if not given.

        A point that is not finite counts as unseen (weight 0). Raises :class:`InputError`
        (``target.shape``) for arrays that are not of one count,
        (``target.weight``) for a negative or infinite weight, (``target.no_weight``) if nothing is
        left to fit.
        """
        if np.ndim(points) != 2 or np.shape(points)[1] != 3:
            message = f"the target's points have the shape {np.shape(points)}, not (k, 3)"
            raise InputError("target.shape", message)
        weights = np.ones(len(points)) if weights is None else weights.astype(np.float64)
        for what, found, shape in (
            ("weights", weights, (len(points),)),
            ("normals", points if normals is None else normals, np.shape(points)),
        ):
            if np.shape(found) != shape:
                message = f"the target's {what} have the shape {np.shape(found)}, not {shape}"
                raise InputError("target.shape", message)
        seen = np.asarray(np.isfinite(points).all(axis=1))
        if normals is not None:
            seen &= np.isfinite(normals).all(axis=1)
            normals = np.where(seen[:, None], normals, 0.0)
        weights = np.where(seen, weights, 0.0)
        wrong = np.flatnonzero(~((weights >= 0.0) & np.isfinite(weights)))
        if len(wrong):
            message = f"the weight of the target's point {wrong[0]} is {weights[wrong[0]]}"
            raise InputError("target.weight", message, vertex=int(wrong[0]))
        if not weights.any():
            raise InputError("target.no_weight", "no point of the target has a positive weight")
        return cls(np.where(seen[:, None], points, 0.0), weights / weights.sum(), normals)

    def value(self, points: Floats) -> float:
        """Return sum_v w_v |p_v - t_v|^2, or of the distances along the normals, in mm^2."""
        return float(self.weights @ np.sum(self.offset(points) ** 2, axis=1))

    def distances(self, points: Floats) -> Floats:
        """Return |p_v - t_v|, or that along the normals, (k,) mm; NaN where it has no point."""
        distance = np.linalg.norm(self.offset(points), axis=1)
        return np.where(self.weights > 0.0, distance, np.nan)

    def offset(self, points: Floats) -> Floats:
        """Return p_v - t_v (k, 3), along the normals where there are any."""
        offset = points - self.points
        if self.normals is None:
            return offset
        return np.asarray(np.sum(offset * self.normals, axis=1, keepdims=True) * self.normals)


class Prior(Protocol):
    """A part of f that depends on the pose alone: how probable it is."""

    def value(self, pose: Pose) -> float:
        """Return the part."""

    def gradient(self, pose: Pose) -> Floats:
        """Return its derivative by the controls (k,)."""

    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        """Add its positive semi-definite Gauss-Newton Hessian to ``out`` (k, k)."""

    def gauss_newton(self, pose: Pose) -> Floats:
        """Return its Gauss-Newton Hessian (k, k)."""
        out = np.zeros((pose.layout.size, pose.layout.size))
        self.add_gauss_newton(pose, out)
        return out


@dataclass(frozen=True)
class Regulariser(Prior):
    """Priors of a pose, with their weights."""

    w_a: float | Floats  # of activations; or (m, 1), each muscle's
    w_v: float  # of volume
    w_b: float
    prior: Pose
    w_e: float = 0.1  # of least eigenvalues
    others: tuple[Prior, ...] = ()  # beside these, as of what a table knows of muscles

    def with_proximal_term(self, pose: Pose, weight: float) -> Regulariser:
        """Return, but for a constant, the sum with ``weight``/2 |a - a_pose|^2, the jaw's alike."""
        if weight == 0.0:
            return self
        total = self.w_a + weight
        # the jaw's weight grows as that of the muscles that pay least does
        least = float(np.min(self.w_a))
        sum_of_least = float(np.min(total))
        w_b = self.w_b * (sum_of_least / least if least > 0.0 else 1.0)
        part = weight / total
        prior = replace(
            self.prior,
            a=self.prior.a + part * (pose.a - self.prior.a),
            b=self.prior.b + weight / sum_of_least * (pose.b - self.prior.b),
        )
        return replace(self, w_a=total, w_b=w_b, prior=prior)

    def value(self, pose: Pose) -> float:
        """Return the regularisers' sum."""
        joints = pose.layout.joint_units * (pose.b - self.prior.b)
        away = 0.5 * np.sum(self.w_a * (pose.a - self.prior.a) ** 2)
        penalty = pose.layout.drive.penalty
        shapes = penalty.value(pose.a, self.w_v, self.w_e) if penalty else 0.0
        others = sum(other.value(pose) for other in self.others)
        return float(away + shapes + others + 0.5 * self.w_b * joints @ joints)

    def gradient(self, pose: Pose) -> Floats:
        """Return the derivative by (a, b), (size,)."""
        by_a = self.w_a * (pose.a - self.prior.a)
        if penalty := pose.layout.drive.penalty:
            by_a += penalty.gradient(pose.a, self.w_v, self.w_e)
        by_b = self.w_b * pose.layout.joint_units**2 * (pose.b - self.prior.b)
        others = (other.gradient(pose) for other in self.others)
        return sum(others, pose.layout.join([by_a, by_b]))

    def curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """Return the Gauss-Newton Hessian: a block of each a_j, (m, k, k), and b's diagonal.

        What joins the blocks of two muscles, in the other priors, is left out here.
        """
        blocks, diagonal = self._curvature(pose)
        muscles = pose.layout.muscles
        for other in self.others:
            blocks += other.gauss_newton(pose)[muscles[:, :, None], muscles[:, None, :]]
        return blocks, diagonal

    def _curvature(self, pose: Pose) -> tuple[Floats, Floats]:
        """Return the same without the other priors."""
        muscles = pose.layout.muscles
        each = np.arange(muscles.shape[1])
        blocks = np.zeros((*muscles.shape, muscles.shape[1]))
        if penalty := pose.layout.drive.penalty:
            blocks += penalty.curvature(pose.a, self.w_v, self.w_e)
        blocks[:, each, each] += self.w_a
        return blocks, self.w_b * pose.layout.joint_units**2

    @override
    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        layout = pose.layout
        blocks, diagonal = self._curvature(pose)
        out[layout.muscles[:, :, None], layout.muscles[:, None, :]] += blocks
        joints = layout.joint_places
        out[joints, joints] += diagonal
        for other in self.others:
            other.add_gauss_newton(pose, out)


class SquaredPrior(Prior):
    """The price w/2 |r|^2 of residuals r by the controls, w being its ``weight``."""

    weight: float

    @abstractmethod
    def residuals(self, pose: Pose) -> Floats:
        """Return r."""

    @override
    def value(self, pose: Pose) -> float:
        left = self.residuals(pose)
        return float(0.5 * self.weight * left @ left)


@dataclass(frozen=True)
class PartPrior(Prior):
    """-log of N(mean, P^-1) over some entries of the controls (size,), but for a constant."""

    size: int
    places: Ints  # (j,) of the entries
    mean: Floats  # (j,)
    precision: Floats  # P (j, j)

    @override
    def value(self, pose: Pose) -> float:
        away = pose.vector()[self.places] - self.mean
        return float(0.5 * away @ self.precision @ away)

    @override
    def gradient(self, pose: Pose) -> Floats:
        out = np.zeros(self.size)
        out[self.places] = self.precision @ (pose.vector()[self.places] - self.mean)
        return out

    @override
    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        out[np.ix_(self.places, self.places)] += self.precision


@dataclass(frozen=True)
class PriorSum(Prior):
    """The sum of priors."""

    priors: tuple[Prior, ...]

    @override
    def value(self, pose: Pose) -> float:
        return sum(prior.value(pose) for prior in self.priors)

    @override
    def gradient(self, pose: Pose) -> Floats:
        return np.asarray(sum(prior.gradient(pose) for prior in self.priors))

    @override
    def add_gauss_newton(self, pose: Pose, out: Floats) -> None:
        for prior in self.priors:
            prior.add_gauss_newton(pose, out)


@dataclass(frozen=True)
class GramCurvature:
    """A Gauss-Newton Hessian A^T K A (3 p, 3 p) of few rows: sparse A (r, 3 p), dense K (r, r)."""

    rows: sp.csr_array
    inner: Floats

    def __matmul__(self, vector: Floats) -> Floats:
        return np.asarray(self.rows.T @ (self.inner @ (self.rows @ vector)))

    def __add__(self, other: Curvature) -> Curvature:
        if not isinstance(other, GramCurvature):
            return self.sparse() + other
        rows = sp.csr_array(sp.vstack([self.rows, other.rows]))
        return GramCurvature(rows, scipy.linalg.block_diag(self.inner, other.inner))

    def sparse(self) -> sp.csr_array:
        """Return the whole matrix."""
        return sp.csr_array(self.rows.T @ sp.csr_array(self.inner) @ self.rows)

    __radd__ = __add__


Curvature: TypeAlias = sp.csr_array | GramCurvature


def sparse(curvature: Curvature) -> sp.csr_array:
    """Return a Gauss-Newton Hessian as one matrix (3 p, 3 p)."""
    return curvature.sparse() if isinstance(curvature, GramCurvature) else curvature


class Term(Protocol):
    """A part of f that depends on the tets' vertices x (p, 3) alone, held ones included, in mm.

    What rides on the mandible is an affine combination of its vertices, so no term needs b.
    """

    def value(self, x: Floats) -> float:
        """Return the term in mm^2."""

    def gradient(self, x: Floats) -> Floats:
        """Return its derivative by x, (p, 3)."""

    def curvature(self, x: Floats) -> Curvature:
        """Return the positive semi-definite Gauss-Newton Hessian by x, (3 p, 3 p)."""


class SkinDistance(Term):
    """sum_v w_v |(M x)_v - t_v|^2, or sum_v w_v (n_v . ((M x)_v - t_v))^2: the published terms.

    The second, point to plane, where the :class:`Target` has normals.
    """

    def __init__(self, face: Face, target: Target) -> None:
        if len(target.points) != len(face.model.face):
            message = (
                f"the target has {len(target.points)} points, the face {len(face.model.face)}: "
                "take those of its vertices, skin[model.face]"
            )
            raise InputError("target.shape", message)
        self._face = face
        self.target = target

    @override
    def value(self, x: Floats) -> float:
        return self.target.value(self._face.face_points(x))

    @override
    def gradient(self, x: Floats) -> Floats:
        offset = self.target.offset(self._face.face_points(x))
        by_point = 2.0 * self.target.weights[:, None] * offset
        return np.asarray(self._face.face_embedding.T @ by_point)

    @override
    def curvature(self, x: Floats) -> sp.csr_array:
        return self._curvature

    @cached_property
    def _curvature(self) -> sp.csr_array:
        M = self._face.face_embedding
        unit = sp.eye_array(3)
        weights = self.target.weights
        normals = self.target.normals
        if normals is None:
            by_vertex = 2.0 * M.T @ sp.diags_array(weights) @ M
            return sp.csr_array(sp.kron(by_vertex, unit, format="csr"))
        along = (normals * np.sqrt(2.0 * weights)[:, None]).ravel()
        each = np.arange(len(along))
        root = sp.csr_array((along, (each // 3, each))) @ sp.kron(M, unit, format="csr")
        return sp.csr_array(root.T @ root)


def distances(face: Face, targets: Mapping[str, Target]) -> dict[str, Term]:
    """Return the distance of every expression, without contact: what a fit of S begins with."""
    return {name: SkinDistance(face, target) for name, target in targets.items()}


@dataclass(frozen=True)
class SumTerm(Term):
    """The sum of terms."""

    terms: tuple[Term, ...]

    @override
    def value(self, x: Floats) -> float:
        return sum(term.value(x) for term in self.terms)

    @override
    def gradient(self, x: Floats) -> Floats:
        return np.asarray(sum(term.gradient(x) for term in self.terms))

    @override
    def curvature(self, x: Floats) -> Curvature:
        return reduce(operator.add, (term.curvature(x) for term in self.terms))
