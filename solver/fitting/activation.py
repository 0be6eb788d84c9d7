"""(A): activations and jaw of one expression, S being known.

Reduced-space Gauss-Newton: x is eliminated through the equilibrium, the dense Jacobian by (a, b)
comes from one factorisation, and Levenberg-Marquardt damping keeps the steps in reach. On the way
the equilibrium is only approached: one or two Newton corrections a step, the rest of the way being
part of the linear model, as in a full-space (SQP) method. The last state is settled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting.face import Face, Pose, State
from solver.fitting.objective import JAW_UNITS, Regulariser
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.terms import Term
from solver.surface import Floats

DAMPING_START = 0.1
DAMPING_GROWTH = 8.0
DAMPING_LEAST = 1e-6
MAX_TRIALS = 6
"""Steps tried from one state, each shorter and more damped, before it counts as the minimum."""

JAW_DAMPING = 1e-3

LARGEST_STEP = 0.4
LARGEST_TURN = 0.1
"""Trust in the linear model: change of an activation's entry and of the jaw's angles per step."""

SHORTEST_TRUST = 2.0**-6
"""Part of the full trust, halved with every failure, that is kept from step to step."""

SETTLINGS = 3
BUCKLED = 1.005
"""A state whose f grows by more than this factor as it settles was not near its equilibrium."""


@dataclass(frozen=True)
class ActivationOptions:
    """When to stop: after ``max_iterations``, or when a step gains less than ``tolerance`` f."""

    max_iterations: int = 20
    tolerance: float = 1e-4


@dataclass(frozen=True)
class ActivationFit:
    """A fitted state, its objective f, the iterations, and whether they were enough."""

    state: State
    objective: float
    iterations: int
    converged: bool


Listener = Callable[[int, float], None]
"""Called after each accepted step with the iteration and the objective."""

Mover = Callable[[Face, sp.csr_array, State, Floats, Pose], State]
"""Goes from a state to a pose nearby by the flesh's linear response: Face.approach or follow."""


def objective(data: Term, regulariser: Regulariser, state: State) -> float:
    """Return f at a state's estimate (see :mod:`solver.fitting.objective`)."""
    return data.value(state.estimate) + regulariser.value(state.pose)


def fit(
    face: Face,
    S: sp.csr_array,
    data: Term,
    regulariser: Regulariser,
    start: State,
    options: ActivationOptions | None = None,
    listen: Listener | None = None,
) -> ActivationFit:
    """Minimise f over (a, b) from ``start`` and settle the result.

    Where the flesh buckles as it settles, the fit goes on from there; if it does not settle at
    all, from the rest pose, with every state on the way settled too. Raises :class:`SolveError`
    (``solve.no_convergence``) if the face can not be settled even so.
    """
    options = options or ActivationOptions()
    best = None
    found = improve(face, S, data, regulariser, start, options, listen)
    iterations = found.iterations
    for _ in range(SETTLINGS):
        state = _settled(face, S, found.state)
        if state is not None:
            value = objective(data, regulariser, state)
            if best is None or value < best.objective:
                best = ActivationFit(state, value, iterations, found.converged)
            if value <= BUCKLED * found.objective:
                break
        go = Face.follow if state is None else Face.approach
        state = best.state if best else face.rest_state(S)
        found = improve(face, S, data, regulariser, state, options, listen, go)
        iterations += found.iterations
    if best is None:
        raise SolveError("solve.no_convergence", "the fitted face does not come to rest")
    return best


def _settled(face: Face, S: sp.csr_array, state: State) -> State | None:
    try:
        return face.settle(S, state.pose, state.x)
    except SolveError:
        return None


def improve(
    face: Face,
    S: sp.csr_array,
    data: Term,
    regulariser: Regulariser,
    start: State,
    options: ActivationOptions,
    listen: Listener | None = None,
    go: Mover = Face.approach,
) -> ActivationFit:
    """Minimise f over (a, b), going from state to state by ``go``; the last is as good as that."""
    state = start
    value = objective(data, regulariser, state)
    damping, trust = DAMPING_START, 1.0
    for iteration in range(1, options.max_iterations + 1):
        model = _linearise(face, S, data, regulariser, state)
        accepted = None
        for _ in range(MAX_TRIALS):
            step = model.step(damping, trust)
            pose = Pose(state.pose.a + step[:-5].reshape(-1, 6), state.pose.b + step[-5:])
            try:
                trial = go(face, S, state, model.flesh @ step, pose)
            except SolveError:
                trial = None
            if trial is not None:
                trial_value = objective(data, regulariser, trial)
                if trial_value < value:
                    accepted = trial
                    break
            damping *= DAMPING_GROWTH
            trust = max(0.5 * trust, SHORTEST_TRUST)
        if accepted is None:
            return ActivationFit(state, value, iteration, True)
        gain = value - trial_value
        if gain > 0.5 * model.predicted_gain(step):
            damping = max(damping / DAMPING_GROWTH, DAMPING_LEAST)
            trust = min(2.0 * trust, 1.0)
        state, value = accepted, trial_value
        if listen:
            listen(iteration, value)
        if gain <= options.tolerance * value:
            return ActivationFit(state, value, iteration, True)
    return ActivationFit(state, value, options.max_iterations, False)


@dataclass(frozen=True)
class _Linearised:
    """The Gauss-Newton model of f at a state, and the flesh's response to a step."""

    gradient: Floats
    hessian: Floats
    flesh: Floats

    def step(self, damping: float, trust: float) -> Floats:
        return damped_step(self.hessian, self.gradient, damping, trust)

    def predicted_gain(self, step: Floats) -> float:
        return float(-self.gradient @ step - 0.5 * step @ self.hessian @ step)


def damped_step(hessian: Floats, gradient: Floats, damping: float, trust: float) -> Floats:
    """Solve (H + damping D^2) step = -gradient, D the units of (a, b); cut to the ``trust``.

    Raises :class:`SolveError` (``solve.not_finite``) where there is no such step.
    """
    damped = hessian.copy()
    damped[np.diag_indices_from(damped)] += damping * damping_units(len(damped))
    try:
        step = np.asarray(scipy.linalg.solve(damped, -gradient, assume_a="pos"))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise SolveError("solve.not_finite", f"no Gauss-Newton step: {error}") from error
    return np.asarray(step / max(reach(step) / trust, 1.0))


def damping_units(size: int) -> Floats:
    """Return the diagonal of D^2, (size,): what damping weighs each entry of (a, b) by."""
    return np.concatenate([np.ones(size - 5), JAW_UNITS**2 * JAW_DAMPING])


def reach(step: Floats) -> float:
    """Return the length of a step (6 m + 5,), 1 being the longest that the linear model is for."""
    by_a, turn = np.abs(step[:-5]).max(), np.abs(step[-5:-3]).max()
    return float(max(by_a / LARGEST_STEP, turn / LARGEST_TURN))


def _linearise(
    face: Face, S: sp.csr_array, data: Term, regulariser: Regulariser, state: State
) -> _Linearised:
    jacobian = Sensitivity(face, S, state).by_pose()
    x = state.estimate
    return _Linearised(
        jacobian.transposed(data.gradient(x)) + regulariser.gradient(state.pose),
        jacobian.contracted(data.curvature(x)) + regulariser.gauss_newton(state.pose),
        jacobian.flesh,
    )
