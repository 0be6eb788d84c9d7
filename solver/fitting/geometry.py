"""The multi-target problem (x, b, a, S): muscle geometry from several expressions at once.

Block coordinate descent as published: activations and jaw of every expression with S held, then S
with the activations held, the weights w_a and w_s falling from round to round.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.fitting import activation, weights
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, State
from solver.fitting.objective import Regulariser, Target
from solver.fitting.terms import SkinDistance, Term
from solver.fitting.weights import WeightProblem

DAMPING_START = 1e-5
"""Of the S block, in units of w_s."""

LAST = ActivationOptions(20, tolerance=1e-3)
"""Of the activations, once S is found."""


@dataclass(frozen=True)
class GeometryOptions:
    """The schedule of the rounds.

    ``w_a`` and ``w_s`` are the weights of the first and last round, geometric in between; the
    prior of both is where the round started. ``w_v`` weighs the muscles' volume.
    """

    rounds: int = 10
    w_a: tuple[float, float] = (0.2, 2e-3)
    w_s: tuple[float, float] = (1e-4, 1e-6)
    w_v: float = 1e-2
    w_b: float = 1e-6
    first_iterations: int = 4
    activation_iterations: int = 2
    geometry_iterations: int = 2

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
"""Called as work begins: block (``activations``, ``geometry``), round, mean error so far in mm."""


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
    data: dict[str, Term] = {name: SkinDistance(face, t) for name, t in targets.items()}
    states = dict.fromkeys(targets, rest)
    steps = dict.fromkeys(targets, 0)
    damping = DAMPING_START
    for number in range(options.rounds):
        w_a, w_s = options.weights(number)
        iterations = options.first_iterations if number == 0 else options.activation_iterations
        for name, term in data.items():
            if listen:
                listen("activations", number, mean_error(face, targets, states))
            prior = face.rest_pose() if number == 0 else states[name].pose
            regulariser = Regulariser(w_a, options.w_v, options.w_b, prior)
            fitted = activation.improve(
                face, S, term, regulariser, states[name], ActivationOptions(iterations, 1e-3)
            )
            states[name] = fitted.state
            steps[name] += fitted.iterations
        if listen:
            listen("geometry", number, mean_error(face, targets, states))
        problem = WeightProblem(face, data, w_s, S.data)
        improved = weights.fit(problem, S, states, options.geometry_iterations, damping)
        S, states, damping = improved.S, improved.states, improved.damping
    # the states were only approached: settle them, together with a last step of the activations
    for name, term in data.items():
        regulariser = Regulariser(options.w_a[1], options.w_v, options.w_b, states[name].pose)
        fitted = activation.fit(face, S, term, regulariser, states[name], LAST)
        states[name] = fitted.state
        steps[name] += fitted.iterations
    return GeometryFit(S, states, steps)


def mean_error(face: Face, targets: Mapping[str, Target], states: Mapping[str, State]) -> float:
    """Return the mean distance over the face skin and the expressions, mm."""
    errors = [
        np.nanmean(target.distances(face.face_points(states[name].estimate)))
        for name, target in targets.items()
    ]
    return float(np.mean(errors))
