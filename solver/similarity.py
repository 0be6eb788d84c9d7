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


def fit_similarity(source: Floats, target: Floats) -> Similarity:
    """Return the best motion of ``source`` (n, 3) onto ``target`` (n, 3) (Umeyama 1991)."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    rotation, trace = _nearest_rotation(b.T @ a)
    scale = trace / float(np.sum(a**2))
    return Similarity(scale, rotation, target_mean - scale * rotation @ source_mean)


def weighted_motion(source: Floats, target: Floats, weights: Floats) -> Similarity:
    """Return the rigid motion (scale 1) of ``source`` (n, 3) onto ``target``, least squares.

    Weighted by ``weights`` (n,) (Kabsch 1976).
    """
    share = weights / weights.sum()
    centre, goal = share @ source, share @ target
    rotation, _ = _nearest_rotation((target - goal).T @ ((source - centre) * share[:, None]))
    return Similarity(1.0, rotation, goal - rotation @ centre)


def robust_motion(
    source: Floats,
    target: Floats,
    weights: Floats,
    slack: float,
    steps: int,
    start: Similarity = IDENTITY,
) -> Similarity:
    """Return the rigid motion that most of ``source`` (n, 3) takes to ``target`` (n, 3).

    From ``start`` points farther from the motion than about ``slack`` lose their say, step by step
    (Geman & McClure 1987).
    """
    motion = start
    for _ in range(steps):
        away = np.linalg.norm(motion(source) - target, axis=1)
        motion = weighted_motion(source, target, weights / (1 + (away / slack) ** 2) ** 2)
    return motion


def _nearest_rotation(moments: Floats) -> tuple[Floats, float]:
    """Return the rotation R with the greatest tr(R^T moments), and that trace."""
    u, sigma, vt = np.linalg.svd(moments)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return (u * signs) @ vt, float(np.sum(sigma * signs))
