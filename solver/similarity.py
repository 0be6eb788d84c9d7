"""A motion with uniform scale: what takes a raw scan into the template's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from solver.surface import Floats


@dataclass(frozen=True)
class Similarity:
    """x -> scale * rotation x + shift; ``rotation`` (3, 3), ``shift`` (3,) in mm."""

    scale: float
    rotation: Floats
    shift: Floats

    def __call__(self, points: Floats) -> Floats:
        """Return the images (n, 3) of ``points`` (n, 3)."""
        return np.asarray(self.scale * points @ self.rotation.T + self.shift)

    def turn(self, directions: Floats) -> Floats:
        """Return rotated ``directions`` (n, 3)."""
        return np.asarray(directions @ self.rotation.T)

    def inverse(self) -> Similarity:
        """Return the motion back."""
        back = self.rotation.T
        return Similarity(1 / self.scale, back, -(back @ self.shift) / self.scale)

    def then(self, after: Similarity) -> Similarity:
        """Return this motion followed by ``after``."""
        return Similarity(
            after.scale * self.scale,
            after.rotation @ self.rotation,
            after.scale * after.rotation @ self.shift + after.shift,
        )

    @property
    def twist(self) -> Floats:
        """Return rotation vector and shift (6,), as :func:`small_motion` takes them."""
        return np.concatenate([Rotation.from_matrix(self.rotation).as_rotvec(), self.shift])

    @property
    def degrees(self) -> float:
        """Return the angle of the rotation in degrees."""
        return float(np.degrees(Rotation.from_matrix(self.rotation).magnitude()))


IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def small_motion(twist: Floats, growth: float = 0.0) -> Similarity:
    """Return the motion of a rotation vector and shift (6,), and a relative growth in size."""
    return Similarity(1.0 + growth, Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:6])


def move_each(matrices: Floats, points: Floats) -> Floats:
    """Return points (n, 3), each moved by a matrix (n, 4, 4) of its own, as skinning blends it."""
    return np.asarray(np.einsum("nij,nj->ni", matrices[:, :3, :3], points) + matrices[:, :3, 3])


def move_each_back(matrices: Floats, points: Floats) -> Floats:
    """Return what :func:`move_each` takes to ``points`` (n, 3)."""
    away = (points - matrices[:, :3, 3])[..., None]
    return np.asarray(np.linalg.solve(matrices[:, :3, :3], away)[..., 0])


def fit_similarity(source: Floats, target: Floats) -> Similarity:
    """Return the best motion of ``source`` (n, 3) onto ``target`` (n, 3) (Umeyama 1991)."""
    source_mean = source.mean(axis=0)
    target_mean = target.mean(axis=0)
    a = source - source_mean
    b = target - target_mean
    rotation, trace = _nearest_rotation(b.T @ a)
    scale = float(trace / np.sum(a**2))
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def weighted_motion(source: Floats, target: Floats, weights: Floats) -> Similarity:
    """Return the rigid motion (scale 1) of ``source`` (n, 3) onto ``target``, least squares.

    Weighted by ``weights`` (n,) (Kabsch 1976).
    """
    rotations, shifts = weighted_motions(source[None], target, weights[None])
    return Similarity(1.0, rotations[0], shifts[0])


def weighted_motions(source: Floats, target: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return rotations (f, 3, 3) and shifts (f, 3) of ``source`` (f, n, 3) onto ``target`` (n, 3).

    Rigid, least squares by ``weights`` (f, n), of every frame at once (Kabsch 1976).
    """
    share = weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
    centre = np.einsum("fn,fni->fi", share, source)
    goal = share @ target
    spread = (source - centre[:, None]) * share[..., None]  # sums to 0: the target need not
    rotations, _ = _nearest_rotation(np.matmul((target - target.mean(axis=0)).T, spread))
    return rotations, goal - np.einsum("fij,fj->fi", rotations, centre)


def robust_weights(squares: Floats) -> Floats:
    """Return weights (1 + r^2)^-2 of the squares r^2 of residuals by their scale.

    A quarter at the scale, next to none far beyond it (Geman & McClure 1987).
    """
    return np.asarray(1.0 / (1.0 + squares) ** 2)


def robust_motion(
    source: Floats,
    target: Floats,
    weights: Floats,
    slack: float,
    steps: int,
    start: Similarity = IDENTITY,
) -> Similarity:
    """Return the rigid motion that most of ``source`` (n, 3) takes to ``target`` (n, 3).

    From ``start`` points farther from the motion than about ``slack`` lose weight, step by step.
    """
    motion = start
    for _ in range(steps):
        away = np.linalg.norm(motion(source) - target, axis=1)
        motion = weighted_motion(source, target, weights * robust_weights((away / slack) ** 2))
    return motion


def robust_motion_of_seen(
    source: Floats, target: Floats, slack: float, steps: int, least: int
) -> Similarity | None:
    """Return :func:`robust_motion` of the points that are finite in both; None of too few.

    It starts from the motion by least squares.
    """
    known = np.isfinite(source).all(axis=1) & np.isfinite(target).all(axis=1)
    if known.sum() < least:
        return None
    pair = (source[known], target[known])
    even = np.ones(int(known.sum()))
    return robust_motion(*pair, even, slack, steps, weighted_motion(*pair, even))


def _nearest_rotation(moments: Floats) -> tuple[Floats, Floats]:
    """Return rotations R (..., 3, 3) with the greatest tr(R^T moments), and these traces."""
    u, sigma, vt = np.linalg.svd(moments)
    signs = np.ones_like(sigma)
    signs[..., 2] = np.sign(np.linalg.det(u @ vt))
    return (u * signs[..., None, :]) @ vt, np.sum(sigma * signs, axis=-1)
