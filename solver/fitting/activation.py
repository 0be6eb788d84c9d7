"""(A): activations and jaw of one expression, S being known.

Reduced-space Gauss-Newton (:mod:`solver.fitting.gauss_newton`): x is eliminated through the
equilibrium, and Levenberg-Marquardt damping and a trust in the linear model keep the steps in
reach. On the way the equilibrium is only approached, the rest of the way being part of the linear
model, as in a full-space (SQP) method. The last state is settled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

from solver.errors import SolveError
from solver.fitting import gauss_newton
from solver.fitting.face import Face, Pose, State
from solver.fitting.gauss_newton import GaussNewton
from solver.fitting.least_squares import (
    DampingOptions,
    Ending,
    LeastSquaresStep,
    Listener,
    StopOptions,
    TrustRegion,
    TrustRegionOptions,
    minimise,
)
from solver.fitting.objective import Regulariser, SkinDistance, Target, Term
from solver.surface import Floats


@dataclass(frozen=True)
class ActivationOptions:
    """When to stop: after ``max_iterations``, or when a step gains less than ``tolerance`` f."""

    max_iterations: int = 20
    tolerance: float = 1e-4


@dataclass(frozen=True)
class DescentOptions:
    """The way down, and from where it begins again.

    Steps longer than ``trust`` allows end, now and then, in flesh that buckles: from there a fit
    takes twice as long, and one of S comes to a worse end.
    """

    damping: DampingOptions = field(
        default_factory=lambda: DampingOptions(0.1, least=1e-6, grow=8.0, shrink=8.0)
    )
    trust: TrustRegionOptions = field(default_factory=TrustRegionOptions)
    settlings: int = 3  # descents, each from the settled end of the one before
    buckled: float = 1.005  # growth of f beyond which a state that settles was not near its rest


@dataclass(frozen=True)
class ActivationFit:
    """A fitted state, its objective f, the iterations, and whether no step gains any more."""

    state: State
    objective: float
    iterations: int
    converged: bool


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
    descent: DescentOptions | None = None,
) -> ActivationFit:
    """Minimise f over (a, b) from ``start`` and settle the result.

    ``matrix`` (6 m + 5, 6 m + 5) is f's Gauss-Newton matrix without its priors, or one like it: of
    a state nearby or of other data (:mod:`solver.fitting.gauss_newton`). Without it that of
    ``start`` is made, which takes as long as a few iterations.

    Where the descent gets stuck, or the flesh buckles as it settles or does not settle at all, the
    fit goes on from the best that did settle, else from the rest pose; in the last case every state
    on the way is settled too. A descent that gets stuck where it began has found the minimum.
    Raises :class:`SolveError` (``solve.no_convergence``) if the face cannot be settled even so.
    """
    options, descent = options or ActivationOptions(), descent or DescentOptions()
    best = None
    iterations, begin, go = 0, start, Face.newton_continuation
    for _ in range(descent.settlings):
        try:
            found = improve(face, data, regulariser, begin, options, listen, go, matrix, descent)
        except SolveError:
            if best is None:
                raise
            break
        iterations += found.iterations
        stuck = not found.converged and found.iterations < options.max_iterations
        state = _settle(face, found.state)
        if state is not None:
            value = objective(data, regulariser, state)
            gained = best is None or value < (1.0 - options.tolerance) * best.objective
            if best is None or value < best.objective:
                best = ActivationFit(state, value, iterations, found.converged)
            if stuck and not gained:
                best = replace(best, converged=True)
                break
            if value <= descent.buckled * found.objective and not stuck:
                break
        matrix = None
        go = Face.predict_and_solve if state is None else Face.newton_continuation
        begin = best.state if best else face.rest
    if best is None:
        raise SolveError("solve.no_convergence", "the fitted face does not come to rest")
    return best


def _settle(face: Face, state: State) -> State | None:
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
    descent: DescentOptions | None = None,
) -> ActivationFit:
    """Minimise f over (a, b), going from state to state by ``go``, which settles them or not.

    It has got stuck where it ends before ``max_iterations`` and has not converged.
    """
    descent = descent or DescentOptions()
    problem = PoseProblem(face, data, regulariser, start, go, matrix)
    stop = StopOptions(options.max_iterations, options.tolerance, options.tolerance)
    found = minimise(problem, start, TrustRegion(descent.damping, descent.trust), stop, listen)
    converged = found.ending == Ending.CONVERGED
    return ActivationFit(found.point, found.value, found.steps + found.idle, converged)


class PoseProblem:
    """f over (a, b) of one expression: a :class:`~solver.fitting.least_squares.Problem`."""

    def __init__(
        self,
        face: Face,
        data: Term,
        regulariser: Regulariser,
        start: State,
        go: Mover,
        matrix: Floats | None,
    ) -> None:
        self._face, self._data, self._regulariser, self._go = face, data, regulariser, go
        self._matrix = gauss_newton.curvature(face, data, start) if matrix is None else matrix
        self._model: GaussNewton | None = None

    def value(self, point: State) -> float:
        """See :class:`LeastSquaresProblem`."""
        return objective(self._data, self._regulariser, point)

    def linearise(self, point: State) -> GaussNewton:
        """See :class:`LeastSquaresProblem`; it begins with the matrix of the model before."""
        matrix = self._model.matrix if self._model else self._matrix
        self._model = GaussNewton(self._face, self._data, self._regulariser, point, matrix)
        return self._model

    def move(self, point: State, step: LeastSquaresStep) -> State | None:
        """See :class:`LeastSquaresProblem`."""
        try:
            return self._go(self._face, point, step.response, point.pose.add(step.change))
        except SolveError:
            return None


# The neutral face, which every fit of an expression can begin with.


class Resting:
    """Neutral face, common to all expressions: ``state`` is its equilibrium.

    Raises :class:`SolveError` if there is none.
    """

    def __init__(self, face: Face) -> None:
        self._face = face
        self.state: State = face.rest

    @cached_property
    def matrix(self) -> Floats:
        """Return the Gauss-Newton matrix (:func:`gauss_newton.curvature`) for points all alike.

        It is computed when first asked for.
        """
        target = Target.from_points(self._face.face_points(self.state.x))
        data = SkinDistance(self._face, target)
        return gauss_newton.curvature(self._face, data, self.state)
