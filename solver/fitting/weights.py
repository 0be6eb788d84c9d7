"""The S block: muscle weights from several expressions whose activations and jaws are held.

Projected Gauss-Newton with Levenberg-Marquardt damping. The normal equations are never formed:
conjugate gradients need only products with dx/dS, one linear solve each way and expression, and
stay on the tangent of the simplex.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.errors import SolveError
from solver.fitting import simplex
from solver.fitting.face import Face, State
from solver.fitting.sensitivity import Sensitivity, coordinates
from solver.fitting.terms import Term
from solver.surface import Floats

HALVINGS = 5
CG_ITERATIONS = 30
CG_TOLERANCE = 0.05
LEAST_GAIN = 1e-3
"""A step that gains less than this part of the objective is the round's last."""


@dataclass(frozen=True)
class WeightProblem:
    """sum_k data_k(x_k(S)) + w_s/2 |S - S_prior|^2, with ``prior`` the values (nnz,) of S."""

    face: Face
    data: Mapping[str, Term]
    w_s: float
    prior: Floats

    def value(self, S: sp.csr_array, states: Mapping[str, State]) -> float:
        """Return the objective at the states' estimates."""
        total = 0.5 * self.w_s * float(np.sum((S.data - self.prior) ** 2))
        return total + sum(term.value(states[name].estimate) for name, term in self.data.items())

    def step(
        self,
        S: sp.csr_array,
        states: Mapping[str, State],
        responses: Mapping[str, Sensitivity],
        damping: float,
    ) -> Floats:
        """Return the change of S's values (nnz,) that minimises the damped linear problem."""
        flesh = self.face.flesh
        places = coordinates(flesh.free)
        gradient = self.w_s * (S.data - self.prior)
        curvatures = {}
        for name, term in self.data.items():
            x = states[name].estimate
            gradient += responses[name].by_geometry_adjoint(term.gradient(x)[flesh.free].ravel())
            curvatures[name] = term.curvature(x)[places][:, places]
        free = simplex.free_entries(S.data, gradient, S.indptr)

        def product(direction: Floats) -> Floats:
            out = (self.w_s + damping) * direction
            for name, response in responses.items():
                pull = curvatures[name] @ response.flesh_by_geometry(direction)
                out += response.by_geometry_adjoint(pull)
            return simplex.tangent(out, free, S.indptr)

        right = -simplex.tangent(gradient, free, S.indptr)
        return conjugate_gradients(product, right, CG_ITERATIONS, CG_TOLERANCE)


@dataclass(frozen=True)
class WeightFit:
    """Improved weights with the states they lead to, and the damping to go on with."""

    S: sp.csr_array
    states: dict[str, State]
    damping: float


def fit(
    problem: WeightProblem,
    S: sp.csr_array,
    states: dict[str, State],
    iterations: int,
    damping: float,
) -> WeightFit:
    """Improve S from ``states`` by at most ``iterations`` steps; it never gets worse.

    The states are only approached, here as in the fit of activations.
    """
    value = problem.value(S, states)
    for _ in range(iterations):
        responses = {name: Sensitivity(problem.face, S, state) for name, state in states.items()}
        step = problem.step(S, states, responses, damping)
        for halving in range(HALVINGS):
            values = simplex.project(S.data + 0.5**halving * step, S.indptr)
            trial = replace_values(S, values)
            near = _approached(problem.face, trial, states, responses, values - S.data)
            if near is not None and problem.value(trial, near) < value:
                break
        else:
            return WeightFit(S, states, damping * 4.0**HALVINGS)
        # a step that had to be halved says how much too far the linear problem reached
        damping *= 4.0**halving if halving else 0.25
        previous, value = value, problem.value(trial, near)
        S, states = trial, near
        if previous - value < LEAST_GAIN * value:
            break
    return WeightFit(S, states, damping)


def replace_values(S: sp.csr_array, values: Floats) -> sp.csr_array:
    """Return a matrix of S's pattern with other values (nnz,)."""
    return sp.csr_array((values, S.indices, S.indptr), shape=S.shape)


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


def _approached(
    face: Face,
    S: sp.csr_array,
    states: Mapping[str, State],
    responses: Mapping[str, Sensitivity],
    change: Floats,
) -> dict[str, State] | None:
    """Approach every pose with S, which has changed by ``change``; None if one is too far."""
    approached = {}
    for name, state in states.items():
        response = responses[name].flesh_by_geometry(change)
        try:
            approached[name] = face.approach(S, state, response, state.pose)
        except SolveError:
            return None
    return approached
