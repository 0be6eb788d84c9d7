"""The multi-target problem (x, b, a, S): muscle geometry from several expressions at once.

Gauss-Newton steps on S and all poses together (:mod:`solver.fitting.joint`), the weights w_a and
w_s falling within the first rounds, their priors the resting muscles and the S of the start.
Admissible activations (:mod:`solver.fitting.drives.admissible`) are so from the start: S that was
fitted to free ones has muscles where these would rather push, and stays near there.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from solver.errors import Finding, InputError
from solver.fitting import activation, fallback, joint, reference, simplex
from solver.fitting.activation import ActivationOptions, rest_curvature
from solver.fitting.face import Face, PosedFace
from solver.fitting.fallback import FallbackFit
from solver.fitting.joint import GeometryProblem, Iterate, Listener
from solver.fitting.known import NOTHING_KNOWN, FaceMuscles
from solver.fitting.least_squares import Listener as StepListener
from solver.fitting.objective import Regulariser, Target, Term
from solver.fitting.recruitment import Recruited
from solver.fitting.reference import NotConvergedError
from solver.fitting.simplex import mix_by_stiffness, replace_values
from solver.mechanics.linear import in_threads
from solver.scans.known_activations import NOTHING, KnownMuscles

NOBODY: Mapping[str, Recruited] = {}  # nothing is known of who makes any expression
LAST = ActivationOptions(20, tolerance=1e-3)  # of the activations, once S is found


@dataclass(frozen=True)
class GeometryOptions:
    """The schedule of the rounds."""

    rounds: int = 20  # at most
    falling: int = 3  # rounds in which the weights fall from their first to their last values
    w_a: tuple[float, float] = (0.2, 1e-3)
    w_s: tuple[float, float] = (1e-4, 1e-5)
    w_v: float = 1e-2  # of the muscles' volume
    w_b: float = 1e-6  # of the jaw
    stiffness: float = 30.0  # of a muscle that contracts, by that of the flesh around it
    first_iterations: int = 4  # of the activations alone, for the first poses
    retries: int = 3  # of a round whose step is refused, each with more damping
    # two rounds in turn that gain less than this part of f are the last
    tolerance: float = 1e-3


@dataclass(frozen=True)
class GeometryFit:
    """The face with its S, and every expression as it was settled, all steps being counted."""

    face: Face
    endings: dict[str, FallbackFit]

    @property
    def S(self) -> sp.csr_array:
        """Return the muscle geometry (n, m + 1)."""
        return self.face.S

    @property
    def states(self) -> dict[str, PosedFace]:
        """Return every expression's state."""
        return {name: ending.state for name, ending in self.endings.items()}


def fit(
    face: Face,
    data: Mapping[str, Term],
    options: GeometryOptions = GeometryOptions(),
    *,
    first_terms: Mapping[str, Term] | None = None,
    start: sp.csr_array | None = None,
    structure: sp.csr_array | None = None,
    recruited: Mapping[str, Recruited] = NOBODY,
    known: Mapping[str, KnownMuscles] = NOTHING_KNOWN,
    listen: Listener | None = None,
) -> GeometryFit:
    """Fit S, activations and jaws to all data, from S ``start`` and the rest pose.

    ``first_terms`` take the place of ``data`` for the first poses: the distance without contact,
    which would take many small steps. ``start`` has the pattern of
    the model's geometric S; if not given it is that, its muscles as stiff as the options say
    (:func:`~solver.fitting.simplex.mix_by_stiffness`). ``structure`` L (k, nnz) adds
    1/2 |L (S - start)|^2 (:mod:`solver.fitting.joint`). ``recruited`` is what single expressions
    call for (:mod:`solver.fitting.recruitment`), ``known`` what tables know of muscles in them
    (:mod:`solver.fitting.known`). An expression that cannot be settled at the end is
    the best that was found of it, and its ending says so.
    """
    first_terms = data if first_terms is None else first_terms
    face = face.with_weights(_start(face, options) if start is None else start)
    first, at_rest = ActivationOptions(options.first_iterations), rest_curvature(face)
    begin = _problem(face, first_terms, options, 0, structure, recruited, known).regularisers

    def descend(name: str) -> PosedFace:
        at = face, first_terms[name], begin[name], face.rest, first
        return activation.descend(*at, go=Face.newton_predict, matrix=at_rest).state

    states = in_threads(descend, first_terms)
    now = Iterate(face.S.data, dict(zip(first_terms, states, strict=True)))

    def problem_of(number: int) -> GeometryProblem:
        return _problem(face, data, options, number, structure, recruited, known)

    rules, rounds = joint.RoundOptions(options.retries, options.tolerance), range(options.rounds)
    now, taken = joint.minimise_rounds(problem_of, now, rounds, rules, listen)
    steps = options.first_iterations + taken
    found = face.with_weights(replace_values(face.S, now.values))
    last = _regularisers(found, data, options, options.w_a[1], recruited, known)
    return _finish(found, data, last, now.states, steps)


def _start(face: Face, options: GeometryOptions) -> sp.csr_array:
    return mix_by_stiffness(face.model.weights, options.stiffness)


def _problem(
    face: Face,
    data: Mapping[str, Term],
    options: GeometryOptions,
    number: int,
    structure: sp.csr_array | None,
    recruited: Mapping[str, Recruited] = NOBODY,
    known: Mapping[str, KnownMuscles] = NOTHING_KNOWN,
) -> GeometryProblem:
    """Return the problem of round ``number`` (from 0); S of ``face`` is its prior."""
    t = min(number / max(min(options.falling, options.rounds) - 1, 1), 1.0)
    w_a, w_s = (first * (last / first) ** t for first, last in (options.w_a, options.w_s))
    regularisers = _regularisers(face, data, options, w_a, recruited, known)
    structure = sp.csr_array((0, face.S.nnz)) if structure is None else structure
    return GeometryProblem(face, data, regularisers, w_s, face.S.data, structure)


def _regularisers(
    face: Face,
    names: Iterable[str],
    options: GeometryOptions,
    w_a: float,
    recruited: Mapping[str, Recruited],
    known: Mapping[str, KnownMuscles],
) -> dict[str, Regulariser]:
    plain = Regulariser(w_a, options.w_v, options.w_b, face.rest_pose())
    muscles, found = FaceMuscles.of(face), {}
    for name in names:
        expected = recruited[name].regularise(plain) if name in recruited else plain
        found[name] = muscles.regularise(known.get(name, NOTHING), expected, plain)
    return found


def _finish(
    face: Face,
    data: Mapping[str, Term],
    regularisers: Mapping[str, Regulariser],
    states: Mapping[str, PosedFace],
    steps: int,
) -> GeometryFit:
    """Settle states that were only approached, together with a last fit of the activations."""

    def settle(name: str) -> FallbackFit:
        ending = fallback.fit(face, data[name], regularisers[name], LAST, start=states[name])
        return replace(ending, iterations=steps + ending.iterations)

    return GeometryFit(face, dict(zip(data, in_threads(settle, data), strict=True)))


def mean_error(face: Face, targets: Mapping[str, Target], states: Mapping[str, PosedFace]) -> float:
    """Return the mean distance over the face skin and the expressions, mm."""
    skins = {name: face.face_points(states[name].estimate) for name in targets}
    return float(np.mean([np.nanmean(targets[name].distances(skins[name])) for name in targets]))


# By IPOPT, for jobs: small meshes only.

MOST_TETS = 2000  # times expressions: beyond, a solve takes hours and gigabytes
TOLERANCE = 1e-4  # IPOPT's
ITERATIONS_A_ROUND = 50  # of IPOPT's


def most_iterations(options: GeometryOptions) -> int:
    """Return how many of IPOPT's iterations stand for the rounds of the options."""
    return ITERATIONS_A_ROUND * options.rounds


def check_size(face: Face, expressions: int) -> None:
    """Raise ``options.too_large`` if IPOPT would not come back in reasonable time."""
    count = expressions * len(face.model.tets)
    if count > MOST_TETS:
        message = (
            f"{expressions} expressions on {len(face.model.tets)} tetrahedra are too many for "
            f"solver ipopt, which takes {MOST_TETS} together: use solver reduced"
        )
        raise InputError("options.too_large", message, expected=MOST_TETS, found=count)


def fit_by_ipopt(
    face: Face,
    data: Mapping[str, Term],
    options: GeometryOptions,
    listen: StepListener | None = None,
    *,
    start: sp.csr_array | None = None,
    structure: sp.csr_array | None = None,
    recruited: Mapping[str, Recruited] = NOBODY,
    known: Mapping[str, KnownMuscles] = NOTHING_KNOWN,
) -> tuple[GeometryFit, tuple[Finding, ...]]:
    """Do as :func:`fit` with the last round's weights.

    Where IPOPT stops early, what it had is settled and kept, and a notice says why. Raises as
    :func:`check_size`.
    """
    check_size(face, len(data))
    fallback.refuse_limits(face)
    face = face.with_weights(_start(face, options) if start is None else start)
    problem = _problem(face, data, options, options.rounds - 1, structure, recruited, known)
    rest, most = dict.fromkeys(data, face.rest), most_iterations(options)
    notices: tuple[Finding, ...] = ()
    try:
        found = reference.geometry(
            problem, rest, tolerance=TOLERANCE, max_iterations=most, listen=listen
        )
    except NotConvergedError as error:
        found = error.last
        notices = (error.notice("the best result so far is kept"),)
    # IPOPT keeps the simplex to its tolerance only
    S = replace_values(face.S, simplex.project(found.S.data, face.S.indptr))
    fitted = face.with_weights(S)
    states = {name: fitted.settle(found.poses[name], found.x[name]) or face.rest for name in data}
    return _finish(fitted, data, problem.regularisers, states, found.iterations), notices
