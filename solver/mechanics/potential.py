"""Potentials beside the flesh's own energy, contact above all, and the boundary they follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from solver.surface import Floats


@dataclass(frozen=True)
class Boundary:
    """Held vertices (h, 3) in the order of ``Flesh.held``, jaw (5,), and objects' vertices (o, 3).

    All in the head's frame, mm.
    """

    held: Floats
    jaw: Floats
    objects: tuple[Floats, ...] = ()

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
    """A boundary's derivatives by k controls: ``held`` (h, 3, k), ``jaw`` (5, k), ``objects``.

    ``objects`` are (o, 3, k) each; without any entry no object moves.
    """

    held: Floats
    jaw: Floats
    objects: tuple[Floats, ...] = ()

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
        """Return the energy of a feasible x; :meth:`longest` tells what is."""

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

    def longest(self, x: Floats, y: Floats, goal: Boundary) -> float:
        """Return the part of the way x -> y, with the rigid parts to ``goal``, that is feasible."""
