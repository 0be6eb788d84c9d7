"""Sensitivities that lag behind, brought up to date by what steps show of them.

A step dq was to move the flesh by J dq and has moved it by dx, which leaves r = dx - J dq. In a
performance the next step goes nearly the same way. Broyden's update (1965),

    J <- J + r v^T,    v = H dq / (dq . H dq),

is the least change of J, measured by H, that would have foreseen dx. The Gauss-Newton matrix
H = J^T C J follows, with w = J^T C r:

    H <- H + w v^T + v w^T + (r . C r) v v^T

J is large and lies in single precision: updates are kept beside it, and added where there are many.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.fitting.objective import Curvature, Term
from solver.fitting.sensitivity import Jacobian
from solver.surface import Floats


@dataclass(frozen=True)
class SecantOptions:
    """Which steps tell of the sensitivities."""

    most: int = 40  # updates beside the sensitivities, that many being added to them at once
    least: float = 0.02  # |r| by |dq|, in the norms of C and H, below which all was foreseen ...
    wild: float = 2.0  # ... and above which the flesh has buckled, of which no line tells


class LaggedModel:
    """Sensitivities of a state before, and the pose's Gauss-Newton matrix without priors."""

    def __init__(
        self,
        jacobian: Jacobian,
        data: Term,
        weights: Floats,
        x: Floats,
        options: SecantOptions | None = None,
    ) -> None:
        """Linearise ``data`` at x (p, 3), its points having ``weights`` (k,).

        Without ``options`` nothing is learned.
        """
        self.jacobian = jacobian
        self.weights = weights
        self._curvature: Curvature = data.curvature(x)
        self.hessian = jacobian.contract(self._curvature)
        self._options = options
        self._left: list[Floats] = []  # (size,) r
        self._along: list[Floats] = []  # (k,) v

    def flesh_motion(self, change: Floats) -> Floats:
        """Return the free coordinates' motion (size,) for a ``change`` (k,) of q."""
        motion = self.jacobian.flesh_motion(change)
        for left, along in zip(self._left, self._along, strict=True):
            motion += (along @ change) * left
        return motion

    def adjoint(self, gradient: Floats) -> Floats:
        """Return (dx/dq)^T g (k,) for g by x, (p, 3)."""
        found = self.jacobian.adjoint(gradient)
        pull = gradient.ravel()[self.jacobian.free]
        for left, along in zip(self._left, self._along, strict=True):
            found += (left @ pull) * along
        return found

    def learn(self, change: Floats, left: Floats) -> None:
        """Learn of a ``change`` (k,) of q what its motion ``left`` to be foreseen, (size,)."""
        options = self._options
        if options is None:
            return
        ahead = self.hessian @ change
        size = float(change @ ahead)
        motion = np.zeros(self.jacobian.held.shape[0])
        motion[self.jacobian.free] = left
        pull = self._curvature @ motion
        square = float(motion @ pull)
        if not options.least**2 * size < square < options.wild**2 * size:
            return
        along = ahead / size
        ways = np.stack([self.adjoint(pull) + 0.5 * square * along, along])
        self.hessian += ways.T @ ways[::-1]
        self._left.append(left)
        self._along.append(along)
        if len(self._left) == options.most:
            added = np.array(self._left, np.float32).T @ np.array(self._along, np.float32)
            self.jacobian = self.jacobian.plus(added)
            self._left.clear()
            self._along.clear()
