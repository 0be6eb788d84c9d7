"""(A): activations and jaw of one expression, S being known.

Reduced-space Gauss-Newton (:mod:`solver.fitting.gauss_newton`): x is eliminated through the
equilibrium, and Levenberg-Marquardt damping and a trust in the linear model keep the steps in
reach. On the way the equilibrium is only approached, the rest of the way being part of the linear
model, as in a full-space (SQP) method. The last state is settled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from solver.errors import SolveError
from solver.fitting import gauss_newton
from solver.fitting.face import Face, Pose, State
from solver.fitting.gauss_newton import GaussNewton, Step
from solver.fitting.objective import Regulariser, SkinDistance, Target, Term
from solver.surface import Floats

DAMPING_START = 0.1
DAMPING_CHANGE = 8.0
DAMPING_LEAST = 1e-6
MAX_TRIALS = 6
"""Steps tried from one state, each shorter and more damped, before the descent counts as stuck."""

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
    """A fitted state, its objective f, the iterations, and whether no step gains any more."""

    state: State
    objective: float
    iterations: int
    converged: bool


Listener = Callable[[int, float], None]
"""Called after each accepted step with the iteration and the objective."""

# from a state to a pose nearby by the flesh's linear response: Face.newton_predict,
# newton_continuation or predict_and_solve
Mover = Callable[[Face, State, Floats, Pose], State]


def objective(data: Term, regulariser: Regulariser, state: State) -> float:
    """Return f at a state's estimate (see :mod:`solver.fitting.objective`)."""
    return data.value(state.estimate) + regulariser.value(state.pose)


def fit(
    face: Face,
    data: Term,
    regulariser: Regulariser,
    start: State,
    options: ActivationOptions | None = None,
    listen: Listener | None = None,
    *,
    matrix: Floats | None = None,
) -> ActivationFit:
    """Minimise f over (a, b) from ``start`` and settle the result.

    ``matrix`` (6 m + 5, 6 m + 5) is f's Gauss-Newton matrix without its priors, or one like it: of
    a state nearby or of other data (:mod:`solver.fitting.gauss_newton`). Without it that of
    ``start`` is made, which takes as long as a few iterations.

    Where the descent gets stuck, or the flesh buckles as it settles or does not settle at all, the
    fit goes on from the best that did settle, else from the rest pose; in the last case every state
    on the way is settled too. A descent that gets stuck where it began has found the minimum.
    Raises :class:`SolveError` (``solve.no_convergence``) if the face can not be settled even so.
    """
    options = options or ActivationOptions()
    best = None
    iterations, begin, go = 0, start, Face.newton_continuation
    for _ in range(SETTLINGS):
        try:
            found = improve(face, data, regulariser, begin, options, listen, go, matrix)
        except SolveError:
            if best is None:
                raise
            break
        iterations += found.iterations
        stuck = not found.converged and found.iterations < options.max_iterations
        state = _settled(face, found.state)
        if state is not None:
            value = objective(data, regulariser, state)
            gained = best is None or value < (1.0 - options.tolerance) * best.objective
            if best is None or value < best.objective:
                best = ActivationFit(state, value, iterations, found.converged)
            if stuck and not gained:
                best = replace(best, converged=True)
                break
            if value <= BUCKLED * found.objective and not stuck:
                break
        matrix = None
        go = Face.predict_and_solve if state is None else Face.newton_continuation
        begin = best.state if best else face.rest_state()
    if best is None:
        raise SolveError("solve.no_convergence", "the fitted face does not come to rest")
    return best


def _settled(face: Face, state: State) -> State | None:
    try:
        return face.solve_equilibrium(state.pose, state.x, state.equilibrium.factor)
    except SolveError:
        return None


def improve(
    face: Face,
    data: Term,
    regulariser: Regulariser,
    start: State,
    options: ActivationOptions,
    listen: Listener | None = None,
    go: Mover = Face.newton_continuation,
    matrix: Floats | None = None,
) -> ActivationFit:
    """Minimise f over (a, b), going from state to state by ``go``, which settles them or not.

    It has got stuck where it ends before ``max_iterations`` and has not converged.
    """
    state = start
    value = objective(data, regulariser, state)
    matrix = gauss_newton.curvature(face, data, state) if matrix is None else matrix
    trust = _Trust()
    for iteration in range(1, options.max_iterations + 1):
        model = GaussNewton(face, data, regulariser, state, matrix)
        better = None
        for trial in range(MAX_TRIALS):
            step = model.step(trust.damping, trust.reach)
            # a step that was cut says nothing of what is left
            whole = step.reach < 0.99 * trust.reach
            if not trial and whole and step.gain <= options.tolerance * value:
                return ActivationFit(state, value, iteration, True)
            better = _tried(face, state, step, go)
            if better is None:
                trust.shrink(step.reach)
                continue
            reached = objective(data, regulariser, better)
            trust.adapt((value - reached) / step.gain, step.reach)
            if reached < value:
                break
            better = None
        if better is None:
            return ActivationFit(state, value, iteration, False)
        matrix = model.matrix
        gain = value - reached
        state, value = better, reached
        if listen:
            listen(iteration, value)
        if whole and gain <= options.tolerance * value:
            return ActivationFit(state, value, iteration, True)
    return ActivationFit(state, value, options.max_iterations, False)


def _tried(face: Face, state: State, step: Step, go: Mover) -> State | None:
    """Return the state a step leads to, None where that is too far."""
    try:
        return go(face, state, step.response, state.pose.add(step.change))
    except SolveError:
        return None


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


# The neutral face, which every fit of an expression can begin with.


class Resting:
    """What all expressions of a face share: ``state``, the neutral face as an equilibrium.

    Raises :class:`SolveError` if there is none.
    """

    def __init__(self, face: Face) -> None:
        self._face = face
        self.state: State = face.rest_state()

    @cached_property
    def matrix(self) -> Floats:
        """Return the Gauss-Newton matrix (:func:`gauss_newton.curvature`) for points all alike.

        It is computed when first asked for.
        """
        target = Target.from_points(self._face.face_points(self.state.x))
        data = SkinDistance(self._face, target)
        return gauss_newton.curvature(self._face, data, self.state)
