"""Springs that pull muscles to their targets, and activations, as controls of the flesh.

    E_tracks = 1/2 sum_v k_v |x_v - M_v|^2,    k_v = mu / l^2 sum_j f_j V_vj

V_vj is the volume at vertex v that muscle j has by its shares of the tets, f_j a factor of the
muscle, and l the length from its target at which a muscle is held as stiffly as by its own flesh.

The flesh's controls are the tets' activations and the targets of the vertices with springs, one
after the other: whatever moves or differentiates flesh by its controls does so of tracks, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numba as nb
import numpy as np
import scipy.sparse as sp
from typing_extensions import override

from solver.mechanics.flesh import IDENTITY, Flesh
from solver.mechanics.terms import ElasticTerm, EnergyTerm, Springs
from solver.surface import Floats, Ints


class _TrackedElastic(EnergyTerm):
    """The law of the tets, whose activations are the first of the controls."""

    def __init__(self, elastic: ElasticTerm) -> None:
        self._elastic = elastic
        self.vertices = elastic.vertices
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
        return np.concatenate([A.ravel(), self.places(target)])

    def places(self, target: Floats) -> Floats:
        """Return the springs' coordinates (3 s, ...) among (p, 3, ...) of all vertices."""
        found = target[self.springs.vertices[:, 0]]
        return found.reshape(3 * len(found), *target.shape[2:])

    @cached_property
    def forces_by_place(self) -> sp.csr_array:
        """The free gradient's derivative (size, 3 s) by the springs' places."""
        numbers = self.flesh.free_numbers[self.springs.vertices[:, 0]]
        rows = (3 * numbers[:, None] + np.arange(3)).ravel()
        values = -np.repeat(self.springs.stiffness, 3)
        shape = self.flesh.size, len(rows)
        return sp.csr_array((values, (rows, np.arange(len(rows)))), shape=shape)

    def forces_by_stretch(self, x: Floats, controls: Floats, by_stretch: Floats) -> sp.csr_array:
        """Return the free gradient's derivative (size, m) by the stretches of the muscles.

        ``by_stretch`` (m, 6) are the derivatives of their activations.
        """
        muscles = self._muscles
        A = controls[: 6 * len(self.flesh.tets)].reshape(-1, 6)
        by_tet = self.flesh.elastic.forces_by_activation(x, A)
        forces = np.empty((muscles.nnz, 12))
        _force_ways(by_tet, muscles.indptr, muscles.indices, muscles.data, by_stretch, forces)
        entries, places, indptr, indices = self._force_pattern
        data = np.bincount(places, forces.ravel()[entries], len(indices))
        return sp.csr_array((data, indices, indptr), shape=(self.flesh.size, len(by_stretch)))

    @cached_property
    def _muscles(self) -> sp.csr_array:
        """The muscles' shares (n, m)."""
        return self.S[:, 1:]

    @cached_property
    def _force_pattern(self) -> tuple[Ints, Ints, Ints, Ints]:
        """Return, for each muscle, the forces of its tets on free coordinates and their rows.

        The pattern of their sum has the indptr (size + 1,) and the indices that come after.
        """
        muscles = self._muscles.tocoo()
        flesh = self.flesh
        numbers = flesh.free_numbers[flesh.tets[muscles.coords[0]]]
        rows = 3 * numbers[:, :, None] + np.arange(3)
        keys = rows * muscles.shape[1] + muscles.coords[1][:, None, None]
        entries = np.flatnonzero(rows >= 0)
        kept, places = np.unique(keys.ravel()[entries], return_inverse=True)
        row, indices = np.divmod(kept, muscles.shape[1])
        return entries, places, np.searchsorted(row, np.arange(flesh.size + 1)), indices


@nb.njit(cache=True)
def _force_ways(
    by_tet: Floats, indptr: Ints, indices: Ints, shares: Floats, ways: Floats, out: Floats
) -> None:
    """Fill ``out`` (nnz, 12): d(forces of tet i)/dA_i along s_ij times the way (6,) of muscle j."""
    for tet in range(len(by_tet)):
        for entry in range(indptr[tet], indptr[tet + 1]):
            for v in range(4):
                for i in range(3):
                    total = 0.0
                    for q in range(6):
                        total += by_tet[tet, v, i, q] * ways[indices[entry], q]
                    out[entry, 3 * v + i] = shares[entry] * total
