"""dx/dq of a face under tracks, q = (w, j): exact through equilibrium and contact.

    H dx/dq = k dM/dq - (d2E/dx dA) dA/dq - (what bones and contact do as the jaw moves) db/dq

H is the exact Hessian of flesh, springs and contact, indefinite or not. One factorisation serves
columns, products and adjoint products (:mod:`solver.mechanics.response`). Friction is that of the
step which led to the last state: what it remembers is taken as it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting.face import Face
from solver.fitting.markers.term import head_rates
from solver.mechanics.boundary import Boundary, BoundaryRates, Potential, curvature
from solver.mechanics.linear import GrowingSolver
from solver.mechanics.newton import Energy
from solver.mechanics.response import ChainedControls, Response, boundary_forces
from solver.similarity import Similarity
from solver.simulation import MOMENT
from solver.simulation.forces import Drive, FleshMotion
from solver.surface import Floats
from solver.tracks.basis import TrackPose, TrackTargets
from solver.tracks.springs import TrackedFlesh


@dataclass(frozen=True)
class TrackState:
    """Flesh at rest under controls."""

    q: Floats  # (K + 5,) weights of the shapes and the jaw on top of theirs, rad and mm
    pose: TrackPose  # what they ask for
    drive: Drive
    motion: FleshMotion
    residual: float  # see Energy.residual; NaN where it was not asked for
    iterations: int
    inverted: int  # tets
    seconds: float  # that it took

    @property
    def x(self) -> Floats:
        """Return the vertices (p, 3)."""
        return self.motion.x


class TrackedFace(Protocol):
    """What derivatives ask of a :class:`~solver.tracks.face.TrackFace`."""

    face: Face
    potentials: Sequence[Potential]
    targets: TrackTargets
    tracked: TrackedFlesh

    @property
    def exact_solver(self) -> GrowingSolver:
        """Return what factorises exact Hessians, in double precision."""


class TrackResponse:
    """The derivatives of one state; ``minimum`` is False where flesh is about to buckle.

    They are as exact as the state is settled: :class:`~solver.tracks.face.TrackFace` with a
    ``tolerance`` of 1e-9 and ``settled_mm`` of 0 leaves next to nothing, after a second move to the
    same controls where the first was far. Raises
    :class:`~solver.errors.SolveError`: ``tracks.no_equilibrium`` for a state that is none,
    ``solve.singular`` where a part of the flesh is held by nothing.
    """

    def __init__(self, face: TrackedFace, state: TrackState) -> None:
        self._face = face.face
        self._state = state
        flesh = face.face.flesh
        x = state.x
        controls = state.drive.A
        b = state.drive.jaw
        now = Boundary(face.face.held_positions(b), b)
        for each in face.potentials:
            each.place(now)
        energy = Energy(flesh, face.face.linear, controls, face.potentials)
        residual = energy.residual(energy.gradient(x))
        if not residual <= MOMENT.stalled:
            message = f"the state is no equilibrium: its residual is {residual:.1e}"
            raise SolveError("tracks.no_equilibrium", message, residual=residual)
        rates = face.targets.rates(state.q)
        by_jaw = BoundaryRates(face.face.mandible_jacobian(b)[flesh.held], np.eye(len(b)))
        contact = curvature(face.potentials, x)
        pull, held = boundary_forces(flesh, x, controls, by_jaw, face.potentials, contact)
        self._jaw = rates.jaw
        # q moves the muscles' stretches, the springs' places and the jaw, and these the flesh
        by_stretch = face.tracked.forces_by_stretch(x, controls, rates.by_stretch)
        driving = [by_stretch, face.tracked.forces_by_place, sp.csr_array(pull)]
        numbers = [rates.stretches, face.tracked.places(rates.target), rates.jaw]
        self._controls = ChainedControls(
            sp.hstack(driving, format="csr"), np.vstack(numbers), held @ sp.csr_array(rates.jaw)
        )
        self._response = Response.exact(
            flesh, x, controls, contact=contact, linear=face.exact_solver
        )

    @property
    def minimum(self) -> bool:
        """Tell whether the Hessian is positive definite."""
        return self._response.minimum

    def columns(self) -> Floats:
        """Return dx/dq (p, 3, K + 5) of the flesh's vertices."""
        return self._response.motions(self._controls)

    def product(self, change: Floats) -> Floats:
        """Return dx/dq dq (p, 3) for a change (K + 5,) of the controls."""
        return self._response.product(self._controls, change)

    def adjoint(self, gradient: Floats) -> Floats:
        """Return (dx/dq)^T g (K + 5,) for g by the flesh's vertices (p, 3)."""
        return self._response.adjoint(self._controls, gradient)

    def skin_columns(self) -> Floats:
        """Return the derivatives (V, 3, K + 5) of the whole skin."""
        return self._face.skin_rates(self.columns(), self._state.drive.jaw, self._jaw)

    def skin_product(self, change: Floats) -> Floats:
        """Return the skin's motion (V, 3) for a change (K + 5,) of the controls."""
        moved = self.product(change)[:, :, None]
        by_jaw = (self._jaw @ change)[:, None]
        return np.asarray(self._face.skin_rates(moved, self._state.drive.jaw, by_jaw)[:, :, 0])

    def skin_adjoint(self, gradient: Floats) -> Floats:
        """Return the transpose of :meth:`skin_product` applied to g (V, 3): (K + 5,)."""
        by_flesh, by_jaw = self._face.skin_adjoint(gradient, self._state.drive.jaw)
        return np.asarray(self.adjoint(by_flesh) + self._jaw.T @ by_jaw)

    def placed(self, head: Similarity) -> PlacedSkin:
        """Return the derivatives of the skin in the world, where a ``head`` takes it."""
        skin = self._face.whole_skin(self._state.x, self._state.drive.jaw)
        return PlacedSkin(self, head, head(skin))


class PlacedSkin:
    """The derivatives of a ``skin`` (V, 3) in the world by q and by the head, K + 11 controls.

    The last six are a small motion of the head in the world, rotation vector and shift: the
    ``head`` becomes ``head.then(small_motion(six))``.
    """

    def __init__(self, response: TrackResponse, head: Similarity, skin: Floats) -> None:
        self._response = response
        self._turn = head.scale * head.rotation
        self._by_head = head_rates(skin)

    def columns(self) -> Floats:
        """Return the derivatives (V, 3, K + 11)."""
        turned = self._turn @ self._response.skin_columns()
        return np.concatenate([turned, self._by_head.reshape(-1, 3, 6)], axis=2)

    def product(self, change: Floats) -> Floats:
        """Return the skin's motion (V, 3) for a change (K + 11,) of the controls."""
        turned = self._response.skin_product(change[:-6]) @ self._turn.T
        return turned + (self._by_head @ change[-6:]).reshape(-1, 3)

    def adjoint(self, gradient: Floats) -> Floats:
        """Return the transpose of :meth:`product` applied to g (V, 3): (K + 11,)."""
        by_face = self._response.skin_adjoint(gradient @ self._turn)
        return np.concatenate([by_face, self._by_head.T @ gradient.ravel()])
