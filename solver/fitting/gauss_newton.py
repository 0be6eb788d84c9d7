"""The Gauss-Newton model of f at a state, and its damped steps.

    f(p + s) ~ f + g . s + 1/2 s . (J^T C J + R) s,    p = (a, b),    J = dx/dp

The gradient g takes one adjoint solve and a product with J^T C J two solves; the matrix itself
takes as many as p has entries. So a matrix K from a state nearby, or from the same face fitted to
other data, stands in for it: it gives a direction, an exact product says how far to go in it, and
a BFGS update keeps in K what the product told, for the next direction and for the next states.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg

from solver.errors import SolveError
from solver.fitting.controls import Layout
from solver.fitting.face import Face, State
from solver.fitting.least_squares import LeastSquaresStep
from solver.fitting.objective import Regulariser, Term
from solver.fitting.sensitivity import Sensitivity
from solver.surface import Floats

PRODUCTS = 16  # with J^T C J for a step, at most
# length of the correction that a step is left without, relative to it in the model's own norm
ACCURACY = 0.1


class GaussNewton:
    """f's model at ``state``; ``matrix`` (6 m + 5, 6 m + 5) is K, corrected as steps are taken."""

    def __init__(
        self, face: Face, data: Term, regulariser: Regulariser, state: State, matrix: Floats
    ) -> None:
        self._layout = state.pose.layout
        self._sensitivity = Sensitivity(face, state)
        self._curvature = data.curvature(state.estimate)
        self._regulariser = regulariser.gauss_newton(state.pose)
        self._gradient = self._sensitivity.by_pose_adjoint(data.gradient(state.estimate))
        self._gradient += regulariser.gradient(state.pose)
        self.matrix = matrix

    def step(self, damping: float, trust: float) -> LeastSquaresStep:
        """Return the step with ``damping`` D^2 added to the matrix, cut to the reach ``trust``.

        Raises :class:`SolveError` (``solve.not_finite``) where there is none.
        """
        units = damping * self._layout.damping
        known = self._regulariser + np.diag(units)
        step, curved = np.zeros_like(self._gradient), np.zeros_like(self._gradient)
        for _ in range(PRODUCTS):
            residual = -(self._gradient + curved)
            direction = solve_positive(self.matrix + known, residual)
            square = direction @ residual
            if square <= ACCURACY**2 * step @ curved:
                break
            seen = self._product(direction)
            self.matrix = _update(self.matrix, direction, seen)
            image = seen + known @ direction
            length = square / (direction @ image)
            step = step + length * direction
            curved = curved + length * image
        fraction = 1.0 / max(self._layout.reach(step) / trust, 1.0)
        step, curved = fraction * step, fraction * (curved - units * step)
        slope, bend = float(self._gradient @ step), float(step @ curved)
        response = self._sensitivity.flesh_by_pose(step)
        return LeastSquaresStep(step, slope, bend, self._layout.reach(step), response)

    def _product(self, change: Floats) -> Floats:
        """Return J^T C J applied to a change of (a, b)."""
        pull = self._curvature @ self._sensitivity.by_pose_product(change).ravel()
        return self._sensitivity.by_pose_adjoint(pull.reshape(-1, 3))


def curvature(face: Face, data: Term, state: State) -> Floats:
    """Return J^T C J at a state, (6 m + 5, 6 m + 5): f's Gauss-Newton matrix but for its priors."""
    jacobian = Sensitivity(face, state).by_pose()
    return jacobian.contract(data.curvature(state.estimate))


def _update(matrix: Floats, change: Floats, seen: Floats) -> Floats:
    """Return ``matrix`` updated by BFGS so that its product with ``change`` is what was seen."""
    expected = matrix @ change
    guessed, true = float(change @ expected), float(change @ seen)
    # what the data do not feel is left to the regulariser
    if min(guessed, true) <= 1e-12 * np.abs(matrix).max() * float(change @ change):
        return matrix
    matrix = matrix - np.outer(expected, expected) / guessed
    matrix += np.outer(seen, seen) / true
    return matrix


def damped_step(
    layout: Layout, hessian: Floats, gradient: Floats, damping: float, trust: float
) -> Floats:
    """Solve (H + damping D^2) step = -gradient, D the units of ``layout``; cut to the ``trust``.

    Raises :class:`SolveError` (``solve.not_finite``) where there is no such step.
    """
    damped = hessian.copy()
    damped[np.diag_indices_from(damped)] += damping * layout.damping
    step = solve_positive(damped, -gradient)
    return np.asarray(step / max(layout.reach(step) / trust, 1.0))


def solve_positive(matrix: Floats, right: Floats) -> Floats:
    """Return matrix^-1 right for a positive definite matrix.

    Raises :class:`SolveError` (``solve.not_finite``) where it is none.
    """
    try:
        return np.asarray(scipy.linalg.solve(matrix, right, assume_a="pos"))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SolveError("solve.not_finite", f"no Gauss-Newton step: {error}") from error
