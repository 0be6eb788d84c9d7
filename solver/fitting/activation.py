"""(A): activations and jaw of one expression, S being known.

Reduced-space Gauss-Newton: x is eliminated through the equilibrium, the dense Jacobian by (a, b)
comes from one factorisation, and Levenberg-Marquardt damping keeps the steps in reach.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting.face import Face, Pose, State
from solver.fitting.objective import JAW_UNITS, Regulariser, Target
from solver.fitting.sensitivity import Sensitivity
from solver.surface import Floats

DAMPING_START = 0.1
DAMPING_GROWTH = 8.0
DAMPING_LEAST = 1e-6
MAX_TRIALS = 6
"""Steps tried from one state, each more damped, before it counts as the minimum."""

JAW_DAMPING = 1e-3

LARGEST_STEP = 0.4
LARGEST_TURN = 0.1
"""Trust in the linear model: change of an activation's entry and of the jaw's angles per step."""

HALVINGS = 3


@dataclass(frozen=True)
class ActivationOptions:
    """When to stop: after ``max_iterations``, or when a step gains less than ``tolerance`` f."""

    max_iterations: int = 20
    tolerance: float = 1e-4


@dataclass(frozen=True)
class ActivationFit:
    """A fitted state, its objective f and the iterations."""

    state: State
    objective: float
    iterations: int


Listener = Callable[[int, float], None]
"""Called after each accepted step with the iteration and the objective."""


def objective(face: Face, target: Target, regulariser: Regulariser, state: State) -> float:
    """Return f at a settled state (see :mod:`solver.fitting.objective`)."""
    residual = target.residual(face.face_points(state.x))
    return float(residual @ residual) + regulariser.value(state.pose)


def fit(
    face: Face,
    S: sp.csr_array,
    target: Target,
    regulariser: Regulariser,
    start: State,
    options: ActivationOptions | None = None,
    listen: Listener | None = None,
) -> ActivationFit:
    """Minimise f over (a, b) from a settled ``start``."""
    options = options or ActivationOptions()
    state = start
    value = objective(face, target, regulariser, state)
    damping = DAMPING_START
    for iteration in range(1, options.max_iterations + 1):
        model = _linearise(face, S, target, regulariser, state)
        accepted = None
        for _ in range(MAX_TRIALS):
            step = model.step(damping)
            trial = _try(face, S, state, step, model.flesh)
            if trial is not None:
                trial_value = objective(face, target, regulariser, trial)
                if trial_value < value:
                    accepted = trial
                    break
            damping *= DAMPING_GROWTH
        if accepted is None:
            return ActivationFit(state, value, iteration)
        gain = value - trial_value
        if gain > 0.5 * model.predicted_gain(step):
            damping = max(damping / DAMPING_GROWTH, DAMPING_LEAST)
        state, value = accepted, trial_value
        if listen:
            listen(iteration, value)
        if gain <= options.tolerance * value:
            return ActivationFit(state, value, iteration)
    return ActivationFit(state, value, options.max_iterations)


@dataclass(frozen=True)
class _Linearised:
    """The Gauss-Newton model of f at a state, and the flesh's response to a step."""

    gradient: Floats
    hessian: Floats
    flesh: Floats

    def step(self, damping: float) -> Floats:
        """Solve (H + damping D^2) step = -gradient, D the units of (a, b); cut to the trust."""
        damped = self.hessian.copy()
        units = np.concatenate([np.ones(len(damped) - 5), JAW_UNITS**2 * JAW_DAMPING])
        damped[np.diag_indices_from(damped)] += damping * units
        step = np.asarray(scipy.linalg.solve(damped, -self.gradient, assume_a="pos"))
        longest = max(
            np.abs(step[:-5]).max() / LARGEST_STEP, np.abs(step[-5:-3]).max() / LARGEST_TURN
        )
        return np.asarray(step / max(longest, 1.0))

    def predicted_gain(self, step: Floats) -> float:
        return float(-self.gradient @ step - 0.5 * step @ self.hessian @ step)


def _linearise(
    face: Face, S: sp.csr_array, target: Target, regulariser: Regulariser, state: State
) -> _Linearised:
    jacobian = Sensitivity(face, S, state).by_pose()
    weighted = jacobian.skin
    weighted *= np.sqrt(np.repeat(target.weights, 3))[:, None]
    residual = target.residual(face.face_points(state.x))
    return _Linearised(
        2.0 * weighted.T @ residual + regulariser.gradient(state.pose),
        2.0 * weighted.T @ weighted + regulariser.gauss_newton(state.pose),
        jacobian.flesh,
    )


def _try(face: Face, S: sp.csr_array, state: State, step: Floats, flesh: Floats) -> State | None:
    """Settle the face at the stepped pose, halving a step out of reach; None if none goes."""
    for _ in range(HALVINGS):
        pose = Pose(state.pose.a + step[:-5].reshape(-1, 6), state.pose.b + step[-5:])
        try:
            return face.settle(S, pose, face.guess(S, state, flesh @ step, pose))
        except SolveError:
            step *= 0.5
    return None
