"""The multi-target problem by IPOPT, for jobs: small meshes only."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError, SolveError
from solver.fitting import geometry, reference, simplex
from solver.fitting.face import Face, State
from solver.fitting.geometry import GeometryFit, GeometryOptions
from solver.fitting.joint import GeometryProblem
from solver.fitting.notices import Notice
from solver.fitting.objective import Regulariser
from solver.fitting.reference import NotConvergedError
from solver.fitting.reference.common import Listener
from solver.fitting.terms import Term
from solver.fitting.weights import replace_values

MOST_TETS = 2000
"""Tets times expressions beyond which a solve takes hours and gigabytes."""

TOLERANCE = 1e-4
ITERATIONS_A_ROUND = 50


def most_iterations(options: GeometryOptions) -> int:
    """Return how many iterations stand for the rounds of the options."""
    return ITERATIONS_A_ROUND * options.rounds


def check_size(face: Face, expressions: int) -> None:
    """Raise ``options.too_large`` if IPOPT would not come back in reasonable time."""
    count = expressions * len(face.model.tets)
    if count > MOST_TETS:
        raise InputError(
            "options.too_large",
            f"{expressions} expressions on {len(face.model.tets)} tetrahedra are too many for "
            f"solver ipopt, which takes {MOST_TETS} together: use solver reduced",
            expected=MOST_TETS,
            found=count,
        )


def fit(
    face: Face,
    data: Mapping[str, Term],
    options: GeometryOptions,
    listen: Listener | None = None,
    *,
    start: sp.csr_array | None = None,
    structure: sp.csr_array | None = None,
) -> tuple[GeometryFit, tuple[Notice, ...]]:
    """Fit S, activations and jaws with the last round's weights, as :func:`geometry.fit` does.

    Where IPOPT stops early, what it had is settled and kept, and a notice says why. Raises
    :class:`InputError` (:func:`check_size`).
    """
    check_size(face, len(data))
    S = face.model.weights if start is None else start
    structure = sp.csr_array((0, S.nnz)) if structure is None else structure
    rest = face.rest_state(S)
    w_a, w_s = options.weights(options.rounds - 1)
    regulariser = Regulariser(w_a, options.w_v, options.w_b, rest.pose)
    problem = GeometryProblem(face, data, regulariser, w_s, S.data, structure)
    notices: tuple[Notice, ...] = ()
    try:
        found = reference.geometry(
            problem,
            S,
            dict.fromkeys(data, rest),
            tolerance=TOLERANCE,
            max_iterations=most_iterations(options),
            listen=listen,
        )
    except NotConvergedError as error:
        found = error.last
        message = f"{error.message}; the best result so far is kept"
        notices = (Notice(error.code, message, error.context),)
    # IPOPT keeps the simplex to its tolerance only
    fitted = replace_values(S, simplex.project(found.S.data, S.indptr))
    states = {name: _near(face, fitted, found, name, rest) for name in data}
    steps = dict.fromkeys(data, found.iterations)
    return geometry.ended(face, fitted, data, regulariser, states, steps), notices


def _near(
    face: Face, S: sp.csr_array, found: reference.GeometryReference, name: str, rest: State
) -> State:
    """Settle what IPOPT found of an expression; the resting face if that fails."""
    if not np.isfinite(found.x[name]).all():
        return rest
    try:
        return face.settle(S, found.poses[name], found.x[name])
    except SolveError:
        return rest
