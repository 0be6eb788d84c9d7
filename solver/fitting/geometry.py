"""The multi-target problem (x, b, a, S): muscle geometry from several expressions at once.

Gauss-Newton steps on S and all poses together (:mod:`solver.fitting.joint`), the weights w_a and
w_s falling from round to round as published, their priors the resting muscles and the S of the
start.

Admissible activations (:mod:`solver.fitting.drives.admissible`) are reached by continuation: S is
fitted to free ones first, then the bounds close on them round by round. Straight to the bounds,
fits end in worse minima.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sp

from solver.errors import Finding, InputError
from solver.fitting import activation, fallback, joint, reference, simplex
from solver.fitting.activation import ActivationOptions, rest_curvature
from solver.fitting.drives import MuscleDrive
from solver.fitting.face import Face, PosedFace
from solver.fitting.fallback import FallbackFit
from solver.fitting.joint import EndListener, GeometryProblem, Iterate, Listener
from solver.fitting.known import NOTHING_KNOWN, FaceMuscles
from solver.fitting.least_squares import Listener as StepListener
from solver.fitting.objective import Regulariser, Target, Term
from solver.fitting.recruitment import Recruited
from solver.fitting.reference import NotConvergedError
from solver.fitting.simplex import mix_by_stiffness, replace_values
from solver.mechanics.linear import in_threads
from solver.model import SubjectModel
from solver.scans.known_activations import NOTHING, KnownMuscles

WHOLE_ROUNDS = 5  # at the end, which see all terms
NOBODY: Mapping[str, Recruited] = {}  # nothing is known of who makes any expression
LAST = ActivationOptions(20, tolerance=1e-3)  # of the activations, once S is found


@dataclass(frozen=True)
class TighteningOptions:
    """The way from free activations to admissible ones, a round for each step of the bounds."""

    # parts of the way from the limits to those that bind nobody
    loosened: tuple[float, ...] = (0.3, 0.2, 0.12, 0.08, 0.05, 0.02)
    rounds: int = 14  # at most, within the limits as they are asked for
    tolerance: float = 1e-3  # of these: with that of the others they end far from the minimum


@dataclass(frozen=True)
class GeometryOptions:
    """The schedule of the rounds."""

    rounds: int = 12
    w_a: tuple[float, float] = (0.2, 1e-3)  # of the first and last round, geometric in between
    w_s: tuple[float, float] = (1e-4, 1e-5)
    w_v: float = 1e-2  # of the muscles' volume
    w_b: float = 1e-6  # of the jaw
    stiffness: float = 30.0  # of a muscle that contracts, by that of the flesh around it
    first_iterations: int = 4  # of the activations alone, for the first poses
    # by which what both sides do otherwise costs more while S is fitted: S makes sides alike, and
    # poses of a face that is not pay for less
    even: float = 4.0
    retries: int = 3  # of a round whose step is refused, each with more damping
    # where two rounds in turn gain less than this part of f, the fit goes on to the whole rounds,
    # or ends there
    tolerance: float = 3e-3
    # whose bounds close on the muscles in the end; None leaves them as the face has them
    within: MuscleDrive | None = None
    tightening: TighteningOptions = TighteningOptions()

    @property
    def most_rounds(self) -> int:
        """Return how many rounds a fit takes at most."""
        if self.within is None:
            return self.rounds
        way = self.shortened_tightening
        return self.rounds + len(way.loosened) + way.rounds

    def loosened_in(self, number: int) -> float | None:
        """Return the part by which bounds are loosened in round ``number`` (from 0).

        It is 0 within the bounds themselves, and None before there are any.
        """
        parts = self.shortened_tightening.loosened
        if self.within is None or number < self.rounds:
            return None
        return dict(enumerate(parts, self.rounds)).get(number, 0.0)

    @property
    def shortened_tightening(self) -> TighteningOptions:
        """Return the way to admissible activations, shorter for fewer rounds than usual."""
        share = min(self.rounds / GeometryOptions.rounds, 1.0)
        way = self.tightening
        steps = max(round(share * len(way.loosened)), 1)
        chosen = np.linspace(0, len(way.loosened) - 1, steps + 1)[1:].astype(int)
        if steps == len(way.loosened):
            chosen = np.arange(steps)
        loosened = tuple(way.loosened[number] for number in chosen)
        return replace(way, loosened=loosened, rounds=math.ceil(share * way.rounds))


# of fits that begin with a trained S, which is near; some people still gain by a tenth round within
# their limits, a third of the 30 as their rounds are of the usual ones, most end before
TRAINED = GeometryOptions(
    rounds=4, first_iterations=8, tightening=TighteningOptions(rounds=30, tolerance=1e-2)
)


def usual_options(
    model: SubjectModel, within: MuscleDrive | None = None, rounds: int | None = None
) -> GeometryOptions:
    """Return the options of a fit of a model's S, by whether its template is trained."""
    usual = GeometryOptions() if model.trained is None else TRAINED
    return replace(usual, within=within, rounds=usual.rounds if rounds is None else rounds)


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
    ended: EndListener | None = None,
) -> GeometryFit:
    """Fit S, activations and jaws to all data, from S ``start`` and the rest pose.

    Muscles of ``face`` are free; they end ``within`` the options' drive, if there is one.

    ``first_terms`` takes the place of ``data`` in all but the last rounds (:data:`WHOLE_ROUNDS`):
    the distance without contact, which would take many small steps. ``start`` has the pattern of
    the model's geometric S; if not given it is the trained S of the model's template, or else the
    geometric one, its muscles as stiff as the options say
    (:func:`~solver.fitting.simplex.mix_by_stiffness`). ``structure`` L (k, nnz) adds
    1/2 |L (S - start)|^2 (:mod:`solver.fitting.joint`). ``recruited`` is what single expressions
    call for (:mod:`solver.fitting.recruitment`), ``known`` what tables know of muscles in them
    (:mod:`solver.fitting.known`). An expression that cannot be settled at the end is
    the best that was found of it, and its ending says so.
    """
    first_terms = data if first_terms is None else first_terms
    face = face.with_weights(_start(face, options) if start is None else start)
    first = ActivationOptions(options.first_iterations)
    at_rest = rest_curvature(face)
    begin = _problem(face, first_terms, options, 0, structure, recruited, known).regularisers

    def descend(name: str) -> PosedFace:
        at = face, first_terms[name], begin[name], face.rest, first
        return activation.descend(*at, go=Face.newton_predict, matrix=at_rest).state

    states = in_threads(descend, first_terms)
    now = Iterate(face.S.data, dict(zip(first_terms, states, strict=True)))
    steps = options.first_iterations
    whole = max(options.rounds - WHOLE_ROUNDS, 0)
    rules = joint.RoundOptions(options.retries, options.tolerance)
    # rounds that gain nothing end a stage: on to the whole rounds, or to the end
    for terms, rounds in ((first_terms, range(whole)), (data, range(whole, options.rounds))):

        def problem_of(number: int, terms: Mapping[str, Term] = terms) -> GeometryProblem:
            return _problem(face, terms, options, number, structure, recruited, known)

        now, taken = joint.minimise_rounds(problem_of, now, rounds, rules, listen, ended=ended)
        steps += taken
    if options.within is not None:
        face = face.driven_by(options.within)
        newest = face.with_weights(replace_values(face.S, now.values))
        number = options.rounds - 1
        problem = _problem(face, data, options, number, structure, recruited, known, newest)
        now, taken = _tighten(problem, now, options, listen, ended)
        steps += taken
    found = face.with_weights(replace_values(face.S, now.values))
    settled = replace(options, even=1.0)
    last = _regularisers(found, data, settled, options.w_a[1], recruited, known)
    return _finish(found, data, last, now.states, steps)


def _start(face: Face, options: GeometryOptions) -> sp.csr_array:
    model = face.model
    if model.trained is None:
        return mix_by_stiffness(model.weights, options.stiffness)
    return replace_values(model.weights, model.trained.astype(np.float64))


def _tighten(
    problem: GeometryProblem,
    now: Iterate,
    options: GeometryOptions,
    listen: Listener | None,
    ended: EndListener | None,
) -> tuple[Iterate, int]:
    """Go on within bounds that close on those of the problem's drive, and count the rounds."""
    first = options.rounds
    way = options.shortened_tightening
    closed = first + len(way.loosened)

    def enter(number: int, now: Iterate) -> Iterate:
        # along the fibres of the newest S
        face = problem.shape.face(now.values)
        loosened = face.drive.loosen(options.loosened_in(number) or 0.0)
        face = face if loosened is None else face.driven_by(loosened)

        def bring(name: str) -> PosedFace:
            prior = problem.regularisers[name]
            state = now.states[name]
            return activation.enter(face, problem.data[name], prior, state)

        states = in_threads(bring, now.states)
        return replace(now, states=dict(zip(now.states, states, strict=True)))

    taken = 0
    last = range(closed, closed + way.rounds)
    # while bounds close a round need not gain anything
    for rounds, tolerance in ((range(first, closed), -np.inf), (last, way.tolerance)):
        rules = joint.RoundOptions(options.retries, tolerance)
        now, more = joint.minimise_rounds(
            lambda _: problem, now, rounds, rules, listen, enter, ended
        )
        taken += more
    return now, taken


def _problem(
    face: Face,
    data: Mapping[str, Term],
    options: GeometryOptions,
    number: int,
    structure: sp.csr_array | None,
    recruited: Mapping[str, Recruited] = NOBODY,
    known: Mapping[str, KnownMuscles] = NOTHING_KNOWN,
    newest: Face | None = None,
) -> GeometryProblem:
    """Return the problem of round ``number`` (from 0); S of ``face`` is its prior.

    Who pulls is told by the fibres of the ``newest`` S, by default that of ``face``.
    """
    t = number / (options.rounds - 1) if options.rounds > 1 else 1.0  # a single one is the last
    w_a, w_s = (first * (last / first) ** t for first, last in (options.w_a, options.w_s))
    regularisers = _regularisers(newest or face, data, options, w_a, recruited, known)
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
    muscles = FaceMuscles.of(face)
    found = {}
    for name in names:
        expected = plain
        table = known.get(name, NOTHING)
        if name in recruited:
            own = recruited[name].on(face).without(muscles.numbers(table))
            expected = replace(own, even=options.even * own.even).regularise(plain)
        found[name] = muscles.regularise(table, expected)
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
    rest = dict.fromkeys(data, face.rest)
    most = most_iterations(options)
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
