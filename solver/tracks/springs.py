"""Springs that pull muscles to their targets, and activations, as controls of the flesh.

    E_tracks = 1/2 sum_v k_v |x_v - M_v|^2,    k_v = mu / l^2 sum_j f_j V_vj

V_vj is the volume at vertex v that muscle j has by its shares of the tets, f_j a factor of the
muscle, and l the length from its target at which a muscle is held as stiffly as by its own flesh.

The flesh's controls are the tets' activations and the targets of the vertices with springs, one
after the other: whatever moves or differentiates flesh by its controls does so of tracks, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.mechanics.flesh import IDENTITY, Flesh
from solver.mechanics.terms import ElasticTerm, EnergyTerm, Springs
from solver.surface import Floats, Ints


class _TrackedElastic(EnergyTerm):
    """The law of the tets, whose activations are the first of the controls."""

    def __init__(self, elastic: ElasticTerm) -> None:
        self._elastic, self.vertices = elastic, elastic.vertices
        self.size = 6 * len(elastic.vertices)

    @override
    def energy(self, x: Floats, controls: Floats) -> float:
        return self._elastic.energy(x, self._activations(controls))

    @override
    def forces(self, x: Floats, controls: Floats) -> Floats:
        return self._elastic.forces(x, self._activations(controls))

    @override
    def blocks(
        self, x: Floats, controls: Floats, *, project: float = 0.0, some: Ints | None = None
    ) -> Floats:
        return self._elastic.blocks(x, self._activations(controls), project=project, some=some)

    @override
    def forces_by_control(self, x: Floats, controls: Floats) -> sp.csc_array:
        found = self._elastic.forces_by_control(x, self._activations(controls))
        others = sp.csc_array((x.size, controls.size - self.size))
        return sp.csc_array(sp.hstack([found, others], format="csc"))

    def _activations(self, controls: Floats) -> Floats:
        return controls[: self.size].reshape(-1, 6)


class TrackSprings(Springs):
    """Springs to the places (k, 3) that are the last of the controls."""

    @override
    def places(self, controls: Floats) -> Floats:
        return controls[controls.size - self.centre.size :].reshape(-1, 3)

    @override
    def forces_by_control(self, x: Floats, controls: Floats) -> sp.csc_array:
        """Return -k_v for each coordinate of a vertex with a spring."""
        rows = (3 * self.vertices + np.arange(3)).ravel()
        columns = np.arange(controls.size - len(rows), controls.size)
        values = -np.repeat(self.stiffness, 3)
        return sp.csc_array((values, (rows, columns)), shape=(x.size, controls.size))


def spring_stiffness(flesh: Flesh, S: sp.csr_array, factors: Floats, length_mm: float) -> Floats:
    """Return k_v (p,) in Pa mm for muscles with the shares S (n, m + 1) and ``factors`` (m,)."""
    share = np.asarray(S @ np.concatenate([[0.0], factors]))
    corners = np.repeat(flesh.volumes * share / 4.0, 4)
    volume = np.bincount(flesh.tets.ravel(), corners, len(flesh.rest))
    return np.asarray(flesh.material.mu / length_mm**2 * volume)


@dataclass(frozen=True)
class TrackedFlesh:
    """Flesh that tracks drive, by muscles with the shares S (n, m + 1)."""

    flesh: Flesh
    springs: TrackSprings
    S: sp.csr_array

    @classmethod
    def of(cls, flesh: Flesh, S: sp.csr_array, factors: Floats, length_mm: float) -> TrackedFlesh:
        """Hang springs between the muscles of a flesh and targets: :func:`spring_stiffness`."""
        stiffness = spring_stiffness(flesh, S, factors, length_mm)
        vertices = flesh.free[stiffness[flesh.free] > 0.0]
        springs = TrackSprings(vertices[:, None], flesh.rest[vertices], stiffness[vertices])
        passive = np.concatenate([flesh.passive().ravel(), springs.centre.ravel()])
        tracked = flesh.driven_by(_TrackedElastic(flesh.elastic), passive).plus(springs)
        return cls(tracked, springs, S)

    def controls(self, a: Floats, target: Floats) -> Floats:
        """Return the flesh's controls for activations (m, 6) and places (p, 3) of the flesh."""
        A = self.S @ np.vstack([IDENTITY, a])
        return np.concatenate([A.ravel(), target[self.springs.vertices[:, 0]].ravel()])

    def rates(self, a: Floats, target: Floats) -> Floats:
        """Return their derivatives (controls, k) by those of the two, (m, 6, k) and (p, 3, k)."""
        count = a.shape[2]
        by_tet = (self.S[:, 1:] @ a.reshape(len(a), -1)).reshape(-1, count)
        places = target[self.springs.vertices[:, 0]].reshape(-1, count)
        return np.vstack([by_tet, places])
