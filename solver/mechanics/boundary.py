"""The rigid surroundings of flesh, bones, jaw and objects, and potentials of meeting them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.model import JawFrame
from solver.surface import Floats, skew

JAW_FREEDOM = 5  # of the mandible: hinge, sideways, and three of translation


def rotation(axis: Floats, angle: float) -> tuple[Floats, Floats]:
    """Return the rotation about a unit axis (Rodrigues) and its derivative by the angle."""
    across = skew(axis)
    square = across @ across
    sine = np.sin(angle)
    cosine = np.cos(angle)
    return np.eye(3) + sine * across + (1 - cosine) * square, cosine * across + sine * square


def jaw_rotation(frame: JawFrame, b: Floats) -> Floats:
    """Return the mandible's rotation (3, 3) for b (5,): hinge first, then sideways."""
    hinge, sideways, _ = frame.turning
    return rotation(sideways, b[1])[0] @ rotation(hinge, b[0])[0]


def move_jaw(frame: JawFrame, points: Floats, b: Floats) -> Floats:
    """Move points (k, 3) with the mandible by b (5,), in rad and mm."""
    return (points - frame.origin) @ jaw_rotation(frame, b).T + frame.origin + b[2:] @ frame.axes


def move_jaw_back(frame: JawFrame, points: Floats, b: Floats) -> Floats:
    """Undo :func:`move_jaw`: return points (k, 3) of the head as seen from the mandible at b."""
    return (points - frame.origin - b[2:] @ frame.axes) @ jaw_rotation(frame, b) + frame.origin


def jaw_jacobian(frame: JawFrame, points: Floats, b: Floats) -> Floats:
    """Return d move_jaw / db, shape (k, 3, 5)."""
    about_hinge, sideways, _ = frame.turning
    hinge, hinge_rate = rotation(about_hinge, b[0])
    side, side_rate = rotation(sideways, b[1])
    arms = points - frame.origin
    out = np.empty((len(points), 3, JAW_FREEDOM))
    out[:, :, 0] = arms @ (side @ hinge_rate).T
    out[:, :, 1] = arms @ (side_rate @ hinge).T
    out[:, :, 2:] = frame.axes.T
    return out


class JawMotion(Protocol):
    """The mandible's motion by some numbers b (k,)."""

    def move(self, points: Floats, b: Floats) -> Floats:
        """Move points (n, 3) with the mandible."""

    def jacobian(self, points: Floats, b: Floats) -> Floats:
        """Return the derivative (n, 3, k) of :meth:`move` by b."""

    def matrix(self, b: Floats) -> Floats:
        """Return the motion as a matrix (4, 4)."""


def five_numbers(frame: JawFrame, motion: Floats) -> Floats:
    """Return the b (5,) nearest to a rigid motion (4, 4) of the mandible.

    They are the motion itself where its axis through the condyles stays in the plane of their
    tracks, as it does where these are straight.
    """
    turned = frame.turning @ motion[:3, :3] @ frame.turning.T
    hinge = np.arctan2(-turned[1, 2], turned[1, 1])
    side = np.arctan2(-turned[2, 0], turned[0, 0])
    place = motion[:3, :3] @ frame.origin + motion[:3, 3] - frame.origin
    return np.concatenate([[hinge, side], frame.axes @ place])


@dataclass(frozen=True)
class FreeJaw(JawMotion):
    """The mandible by b (5,), whatever its joint can do: :func:`move_jaw`."""

    frame: JawFrame

    @override
    def move(self, points: Floats, b: Floats) -> Floats:
        return move_jaw(self.frame, points, b)

    @override
    def jacobian(self, points: Floats, b: Floats) -> Floats:
        return jaw_jacobian(self.frame, points, b)

    @override
    def matrix(self, b: Floats) -> Floats:
        out = np.eye(4)
        R = jaw_rotation(self.frame, b)
        origin = self.frame.origin
        out[:3, :3] = R
        out[:3, 3] = origin + b[2:] @ self.frame.axes - R @ origin
        return out


@dataclass(frozen=True)
class Boundary:
    """Place of everything rigid in the head's frame, mm."""

    held: Floats  # (h, 3) vertices in the order of ``Flesh.held``
    jaw: Floats  # (5,)
    objects: tuple[Floats, ...] = ()  # vertices (o, 3)

    def toward(self, other: Boundary, part: float) -> Boundary:
        """Return the boundary ``part`` of the straight way to ``other``."""
        held, jaw, *objects = straight(part, self._parts, other._parts)
        return Boundary(held, jaw, tuple(objects))

    def same_as(self, other: Boundary, rounding: float) -> bool:
        """Tell whether two boundaries differ by no more than ``rounding``, mm and rad."""
        pairs = zip(self._parts, other._parts, strict=True)
        return all(np.allclose(a, b, rtol=0.0, atol=rounding) for a, b in pairs)

    @property
    def _parts(self) -> tuple[Floats, ...]:
        return self.held, self.jaw, *self.objects


def straight(part: float, start: Sequence[Floats], end: Sequence[Floats]) -> list[Floats]:
    """Return the arrays ``part`` of the straight way from ``start`` to ``end``."""
    return [a + part * (b - a) for a, b in zip(start, end, strict=True)]


@dataclass(frozen=True)
class BoundaryRates:
    """A boundary's derivatives by k controls."""

    held: Floats  # (h, 3, k)
    jaw: Floats  # (5, k)
    objects: tuple[Floats, ...] = ()  # (o, 3, k) each; none where no object moves

    @property
    def count(self) -> int:
        """Return k."""
        return int(self.jaw.shape[1])


class Potential(Protocol):
    """A part of the energy of vertices x (p, 3) in the head's frame: mm, energies in Pa mm^3."""

    def begin(self, x: Floats, now: Boundary, seconds: float) -> None:
        """Begin a step of so many seconds at x and ``now``: friction remembers what touches."""

    def place(self, boundary: Boundary) -> None:
        """Let everything rigid be where ``boundary`` says, from here on."""

    def value(self, x: Floats) -> float:
        """Return the energy of a feasible x; :meth:`max_step` tells what is."""

    def gradient(self, x: Floats) -> Floats:
        """Return the energy's derivative (p, 3), held vertices included."""

    def hessian(self, x: Floats) -> sp.csr_array:
        """Return a positive semidefinite second derivative (3 p, 3 p)."""

    def curvature(self, x: Floats) -> sp.csr_array:
        """Return the second derivative (3 p, 3 p) as it is, indefinite or not."""

    def by_boundary(self, x: Floats, rates: BoundaryRates) -> Floats:
        """Return the gradient's derivative (p, 3, k) by jaw and objects, x staying where it is."""

    def pull(self, x: Floats, goal: Boundary) -> Floats:
        """Return how the gradient (p, 3) would change if the rigid parts moved to ``goal``."""

    def max_step(self, x: Floats, y: Floats, goal: Boundary) -> float:
        """Return the part of the way x -> y, with the rigid parts to ``goal``, that is feasible."""


def curvature(potentials: Sequence[Potential], x: Floats) -> sp.csr_array:
    """Return the sum of the potentials' exact second derivatives (3 p, 3 p)."""
    return sum((each.curvature(x) for each in potentials), sp.csr_array((x.size, x.size)))
