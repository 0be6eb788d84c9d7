"""Potentials beside the flesh's own energy, contact above all, and the boundary they follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import scipy.sparse as sp

from solver.surface import Floats

# What the flesh is held by and meets, at one moment.


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
        return Boundary(
            self.held + part * (other.held - self.held),
            self.jaw + part * (other.jaw - self.jaw),
            tuple(
                mine + part * (theirs - mine)
                for mine, theirs in zip(self.objects, other.objects, strict=True)
            ),
        )


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
