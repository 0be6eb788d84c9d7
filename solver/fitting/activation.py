"""(A): activations and jaw of one expression, S being known.

Reduced-space Gauss-Newton: x is eliminated through the equilibrium, the dense Jacobian by (a, b)
comes from one factorisation, and Levenberg-Marquardt damping and a trust in the linear model keep
the steps in reach. After a short step the Gauss-Newton matrix is kept and updated by what the exact
gradient, one adjoint solve, tells of it (BFGS): the sensitivities are most of an iteration's cost.
On the way the equilibrium is only approached, the rest of the way being part of the linear model,
as in a full-space (SQP) method. The last state is settled.
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
DAMPING_CHANGE = 8.0
DAMPING_LEAST = 1e-6
MAX_TRIALS = 6
"""Steps tried from one state, each shorter and more damped, before it counts as the minimum."""

KEPT_TRIALS = 2
"""The same with a matrix that was kept: then a new one is made."""

KEPT_REACH = 0.25
"""How far, in steps' reach, a Gauss-Newton matrix is kept."""

JAW_DAMPING = 1e-3

LARGEST_STEP = 0.4
LARGEST_TURN = 0.1
"""Change of an activation's entry and of the jaw's angles in a step of reach 1."""

MOST_TRUST, LEAST_TRUST = 1.0, 2.0**-8
"""Reach that a step is cut to. Longer steps end, now and then, in flesh that buckles: from there a
fit takes twice as long, and one of S comes to a worse end."""

WELL, BADLY = 0.75, 0.25
"""Gains, as parts of the predicted, that make trust grow and shrink."""

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
"""Goes from a state to a pose nearby by the flesh's linear response: Face.approach, travel or
follow."""


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

    Where the flesh buckles as it settles, or does not settle at all, the fit goes on from the best
    that did settle, else from the rest pose; in the second case every state on the way is settled
    too. Raises :class:`SolveError` (``solve.no_convergence``) if the face can not be settled even
    so.
    """
    options = options or ActivationOptions()
    best = None
    iterations, begin, go = 0, start, Face.travel
    for _ in range(SETTLINGS):
        try:
            found = improve(face, S, data, regulariser, begin, options, listen, go)
        except SolveError:
            if best is None:
                raise
            break
        iterations += found.iterations
        state = _settled(face, S, found.state)
        if state is not None:
            value = objective(data, regulariser, state)
            if best is None or value < best.objective:
                best = ActivationFit(state, value, iterations, found.converged)
            if value <= BUCKLED * found.objective:
                break
        go = Face.follow if state is None else Face.travel
        begin = best.state if best else face.rest_state(S)
    if best is None:
        raise SolveError("solve.no_convergence", "the fitted face does not come to rest")
    return best


def _settled(face: Face, S: sp.csr_array, state: State) -> State | None:
    try:
        return face.settle(S, state.pose, state.x, state.equilibrium.factor)
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
    go: Mover = Face.travel,
) -> ActivationFit:
    """Minimise f over (a, b), going from state to state by ``go``, which settles them or not."""
    state = start
    value = objective(data, regulariser, state)
    trust, kept = _Trust(), 0.0
    model = _linearise(face, S, data, regulariser, state)

    def descend(trials: int) -> tuple[State, float, Floats] | None:
        """Return the next state, its f and the step to it; None if no trial is any better."""
        for _ in range(trials):
            step = model.step(trust)
            pose = Pose(state.pose.a + step[:-5].reshape(-1, 6), state.pose.b + step[-5:])
            try:
                trial = go(face, S, state, model.sensitivity.flesh_by_pose(step), pose)
            except SolveError:
                trust.shrink(reach(step))
                continue
            reached = objective(data, regulariser, trial)
            trust.adapt((value - reached) / model.predicted_gain(step), reach(step))
            if reached < value:
                return trial, reached, step
        return None

    for iteration in range(1, options.max_iterations + 1):
        if model.predicted_gain(model.step(trust)) <= options.tolerance * value:
            return ActivationFit(state, value, iteration, True)
        found = descend(KEPT_TRIALS if kept else MAX_TRIALS)
        if found is None and kept:
            model, kept = _linearise(face, S, data, regulariser, state), 0.0
            found = descend(MAX_TRIALS)
        if found is None:
            return ActivationFit(state, value, iteration, True)
        before = value
        state, value, step = found
        if listen:
            listen(iteration, value)
        if before - value <= options.tolerance * value:
            return ActivationFit(state, value, iteration, True)
        kept += reach(step)
        if kept <= KEPT_REACH:
            model = model.updated(face, S, data, regulariser, state, step)
        else:
            model, kept = _linearise(face, S, data, regulariser, state), 0.0
    return ActivationFit(state, value, options.max_iterations, False)


@dataclass
class _Trust:
    """How far the linear model is trusted, and how much it is damped."""

    reach: float = MOST_TRUST
    damping: float = DAMPING_START

    def adapt(self, ratio: float, taken: float) -> None:
        """Learn from a step of reach ``taken`` that gained ``ratio`` of what was promised."""
        if ratio < BADLY:
            self.shrink(taken)
            self.damping *= DAMPING_CHANGE
        elif ratio > WELL:
            self.damping = max(self.damping / DAMPING_CHANGE, DAMPING_LEAST)
            if taken > 0.9 * self.reach:
                self.reach = min(2.0 * self.reach, MOST_TRUST)

    def shrink(self, taken: float) -> None:
        """Trust in steps half as long as the one ``taken``."""
        self.reach = max(0.5 * min(self.reach, taken), LEAST_TRUST)


@dataclass(frozen=True)
class _Model:
    """The quadratic model of f at a state, and the flesh's response to a step."""

    gradient: Floats
    hessian: Floats
    sensitivity: Sensitivity

    def step(self, trust: _Trust) -> Floats:
        return damped_step(self.hessian, self.gradient, trust.damping, trust.reach)

    def predicted_gain(self, step: Floats) -> float:
        return float(-self.gradient @ step - 0.5 * step @ self.hessian @ step)

    def updated(
        self,
        face: Face,
        S: sp.csr_array,
        data: Term,
        regulariser: Regulariser,
        state: State,
        step: Floats,
    ) -> _Model:
        """Return the model at ``state``, a ``step`` away, with this one's matrix updated by BFGS.

        Damped as by Powell (1978), so that it stays positive definite.
        """
        sensitivity = Sensitivity(face, S, state)
        gradient = sensitivity.by_pose_adjoint(data.gradient(state.estimate))
        gradient += regulariser.gradient(state.pose)
        change, expected = gradient - self.gradient, self.hessian @ step
        bend, seen = float(step @ expected), float(step @ change)
        if seen < 0.2 * bend:
            change = expected + 0.8 * bend / (bend - seen) * (change - expected)
        hessian = self.hessian - np.outer(expected, expected) / bend
        hessian += np.outer(change, change) / float(step @ change)
        return _Model(gradient, hessian, sensitivity)


def _linearise(
    face: Face, S: sp.csr_array, data: Term, regulariser: Regulariser, state: State
) -> _Model:
    sensitivity = Sensitivity(face, S, state)
    jacobian = sensitivity.by_pose()
    x = state.estimate
    return _Model(
        jacobian.transposed(data.gradient(x)) + regulariser.gradient(state.pose),
        jacobian.contracted(data.curvature(x)) + regulariser.gauss_newton(state.pose),
        sensitivity,
    )


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
    """Return the length of a step (6 m + 5,) in units of what a linear model is surely good for."""
    by_a, turn = np.abs(step[:-5]).max(), np.abs(step[-5:-3]).max()
    return float(max(by_a / LARGEST_STEP, turn / LARGEST_TURN))
