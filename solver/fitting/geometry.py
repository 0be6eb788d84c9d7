"""The multi-target problem (x, b, a, S): muscle geometry from several expressions at once.

Block coordinate descent as published: activations and jaw of every expression with S held, then S
with the activations held, the weights w_a and w_s falling from round to round. Both blocks are
Gauss-Newton in the reduced space; the S block solves its normal equations by conjugate gradients
with products only, on the tangent of the simplex.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting import activation, simplex
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, State
from solver.fitting.objective import Regulariser, Target, rest_prior
from solver.fitting.sensitivity import Sensitivity
from solver.surface import Floats

HALVINGS = 5


@dataclass(frozen=True)
class GeometryOptions:
    """The schedule of the rounds.

    ``w_a`` and ``w_s`` are the weights of the first and last round, geometric in between; the
    prior of both is where the round started. ``w_v`` weighs the muscles' volume.
    """

    rounds: int = 6
    w_a: tuple[float, float] = (0.2, 2e-3)
    w_s: tuple[float, float] = (1e-4, 1e-6)
    w_v: float = 1e-2
    w_b: float = 1e-6
    first_iterations: int = 4
    activation_iterations: int = 2
    geometry_iterations: int = 2
    cg_iterations: int = 30
    cg_tolerance: float = 0.05
    geometry_tolerance: float = 1e-3

    def weights(self, number: int) -> tuple[float, float]:
        """Return w_a and w_s of round ``number`` (from 0)."""
        t = number / max(self.rounds - 1, 1)
        a, s = (start * (end / start) ** t for start, end in (self.w_a, self.w_s))
        return a, s


@dataclass(frozen=True)
class GeometryFit:
    """S (n, m + 1), and every expression's state and number of activation steps."""

    S: sp.csr_array
    states: dict[str, State]
    iterations: dict[str, int]


Listener = Callable[[str, int, float], None]
"""Called with the block (``activations`` or ``geometry``), the round and the mean error in mm."""


def fit(
    face: Face,
    targets: Mapping[str, Target],
    options: GeometryOptions | None = None,
    listen: Listener | None = None,
) -> GeometryFit:
    """Fit S, activations and jaws to all targets, from the model's initial S and the rest pose."""
    options = options or GeometryOptions()
    S = face.model.weights
    rest = face.rest_state(S)
    states = dict.fromkeys(targets, rest)
    steps = dict.fromkeys(targets, 0)
    for number in range(options.rounds):
        w_a, w_s = options.weights(number)
        iterations = options.first_iterations if number == 0 else options.activation_iterations
        for name, target in targets.items():
            prior = rest_prior(face) if number == 0 else states[name].pose
            regulariser = Regulariser(w_a, options.w_v, options.w_b, prior)
            fitted = activation.fit(
                face, S, target, regulariser, states[name], ActivationOptions(iterations, 1e-3)
            )
            states[name] = fitted.state
            steps[name] += fitted.iterations
            if listen:
                listen("activations", number, mean_error(face, targets, states))
        S, states = _fit_weights(face, S, targets, states, w_s, options)
        if listen:
            listen("geometry", number, mean_error(face, targets, states))
    return GeometryFit(S, states, steps)


def mean_error(face: Face, targets: Mapping[str, Target], states: Mapping[str, State]) -> float:
    """Return the mean distance over the face skin and the expressions, mm."""
    errors = [
        np.nanmean(target.distances(face.face_points(states[name].x)))
        for name, target in targets.items()
    ]
    return float(np.mean(errors))


def _fit_weights(
    face: Face,
    S: sp.csr_array,
    targets: Mapping[str, Target],
    states: dict[str, State],
    w_s: float,
    options: GeometryOptions,
) -> tuple[sp.csr_array, dict[str, State]]:
    """Improve S by projected Gauss-Newton steps, the poses held; return it with the new states."""
    reference = S.data

    def value(values: Floats, at: Mapping[str, State]) -> float:
        """Return sum_k |M x_k - t_k|^2 + w_s/2 |S - S_ref|^2."""
        total = 0.5 * w_s * float(np.sum((values - reference) ** 2))
        for name, target in targets.items():
            residual = target.residual(face.face_points(at[name].x))
            total += float(residual @ residual)
        return total

    best = value(S.data, states)
    for _ in range(options.geometry_iterations):
        responses = {name: Sensitivity(face, S, state) for name, state in states.items()}
        step = _gauss_newton_step(face, S, targets, states, responses, w_s, reference, options)
        for halving in range(HALVINGS):
            trial = replace_values(S, simplex.project(S.data + 0.5**halving * step, S.indptr))
            settled = _settled(face, trial, states, responses, trial.data - S.data)
            if settled is not None and value(trial.data, settled) < best:
                break
        else:
            break
        S, states = trial, settled
        gain, best = best - value(S.data, states), value(S.data, states)
        if gain < options.geometry_tolerance * best:
            break
    return S, states


def replace_values(S: sp.csr_array, values: Floats) -> sp.csr_array:
    """Return a matrix of S's pattern with other values (nnz,)."""
    return sp.csr_array((values, S.indices, S.indptr), shape=S.shape)


def _settled(
    face: Face,
    S: sp.csr_array,
    states: Mapping[str, State],
    responses: Mapping[str, Sensitivity],
    change: Floats,
) -> dict[str, State] | None:
    """Settle every pose with S, which has changed by ``change``; None if one of them can not be."""
    settled = {}
    for name, state in states.items():
        start = face.guess(S, state, responses[name].flesh_by_geometry(change), state.pose)
        try:
            settled[name] = face.settle(S, state.pose, start)
        except SolveError:
            return None
    return settled


def _gauss_newton_step(
    face: Face,
    S: sp.csr_array,
    targets: Mapping[str, Target],
    states: Mapping[str, State],
    responses: Mapping[str, Sensitivity],
    w_s: float,
    reference: Floats,
    options: GeometryOptions,
) -> Floats:
    """Return the change of S's values (nnz,) that minimises the linearised problem."""
    roots = {name: np.sqrt(np.repeat(t.weights, 3)) for name, t in targets.items()}
    gradient = w_s * (S.data - reference)
    for name, target in targets.items():
        residual = target.residual(face.face_points(states[name].x))
        gradient += 2.0 * responses[name].by_geometry_adjoint(roots[name] * residual)
    free = simplex.free_entries(S.data, gradient, S.indptr)

    def product(direction: Floats) -> Floats:
        out = w_s * direction
        for name, response in responses.items():
            weighted = roots[name] ** 2 * response.by_geometry(direction)
            out += 2.0 * response.by_geometry_adjoint(weighted)
        return simplex.tangent(out, free, S.indptr)

    right = -simplex.tangent(gradient, free, S.indptr)
    return conjugate_gradients(product, right, options.cg_iterations, options.cg_tolerance)


def conjugate_gradients(
    product: Callable[[Floats], Floats], right: Floats, iterations: int, tolerance: float
) -> Floats:
    """Solve a symmetric positive semi-definite system to a relative residual, by products only."""
    x = np.zeros_like(right)
    residual = right.copy()
    direction = right.copy()
    square = float(residual @ residual)
    goal = tolerance**2 * square
    for _ in range(iterations):
        if square <= goal or square == 0.0:
            break
        image = product(direction)
        length = square / float(direction @ image)
        x += length * direction
        residual -= length * image
        previous, square = square, float(residual @ residual)
        direction = residual + square / previous * direction
    return x
