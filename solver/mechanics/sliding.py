"""Flesh that slides on a bone: some vertices stay on planes, and move freely in them.

The constraint of Phace (SIGGRAPH 2017), a point on the plane through its rest position, as a stiff
quadratic along the normal: E = sum_k stiffness_k / 2 ((x_k - point_k) . normal_k)^2. It adds to
3x3 diagonal blocks only, so the Hessian keeps its pattern.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.surface import Floats, Ints


@dataclass(frozen=True)
class SlidingPlanes:
    """Planes that vertices slide on: ``vertices`` (k,), ``points`` and unit ``normals`` (k, 3).

    ``stiffness`` (k,) is in stress units times mm.
    """

    vertices: Ints
    points: Floats
    normals: Floats
    stiffness: Floats

    def drift(self, x: Floats) -> Floats:
        """Return how far the vertices ``x`` (p, 3) have left their planes, (k,) mm."""
        return np.asarray(((x[self.vertices] - self.points) * self.normals).sum(axis=1))


class PlanesTerm:
    """The energy of flesh on ``planes``, an :class:`~solver.mechanics.terms.EnergyTerm`."""

    def __init__(self, planes: SlidingPlanes) -> None:
        self._planes = planes
        outer = planes.normals[:, :, None] * planes.normals[:, None, :]
        self._blocks = (planes.stiffness[:, None, None] * outer)[:, None]

    @property
    def vertices(self) -> Ints:
        """See :class:`~solver.mechanics.terms.EnergyTerm`."""
        return self._planes.vertices[:, None]

    def energy(self, x: Floats, controls: Floats) -> float:  # noqa: ARG002
        """See :class:`~solver.mechanics.terms.EnergyTerm`."""
        return float(0.5 * self._planes.stiffness @ self._planes.drift(x) ** 2)

    def forces(self, x: Floats, controls: Floats) -> Floats:  # noqa: ARG002
        """See :class:`~solver.mechanics.terms.EnergyTerm`."""
        along = self._planes.stiffness * self._planes.drift(x)
        return np.asarray(along[:, None] * self._planes.normals)[:, None]

    def blocks(
        self,
        x: Floats,  # noqa: ARG002
        controls: Floats,  # noqa: ARG002
        *,
        project: float = 0.0,  # noqa: ARG002
        some: Ints | None = None,
    ) -> Floats:
        """See :class:`~solver.mechanics.terms.EnergyTerm`."""
        return self._blocks if some is None else self._blocks[some]

    def forces_by_control(self, x: Floats, controls: Floats) -> None:
        """See :class:`~solver.mechanics.terms.EnergyTerm`: none."""


def planes(
    rest: Floats,
    tets: Ints,
    vertices: Ints,
    normals: Floats,
    mu: Floats | float,
    ratio: float = 1000.0,
) -> SlidingPlanes:
    """Return the planes through the rest positions of ``vertices`` (k,), with their stiffness.

    ``rest`` (p, 3) and ``tets`` (n, 4) are the flesh's, ``normals`` (k, 3) of unit length, ``mu``
    is that of all tets or of each (n,). ``ratio`` is the stiffness along the normal over that of
    flesh: a stress of mu lifts a vertex off the bone by a thousandth of its tets' size.
    """
    volume = np.abs(np.linalg.det(rest[tets[:, 1:]] - rest[tets[:, :1]])) / 6.0
    # mu times the size of what is around a vertex, cubed
    cubes = np.bincount(tets.ravel(), np.repeat(mu**3 * volume / 4.0, 4), len(rest))
    return SlidingPlanes(vertices, rest[vertices], normals, ratio * np.cbrt(cubes[vertices]))


def no_planes() -> SlidingPlanes:
    """Return the planes of flesh that slides nowhere."""
    return SlidingPlanes(
        np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    )
