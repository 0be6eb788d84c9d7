"""One Gauss-Newton step on everything the multi-target problem solves for: S, and every a_k, b_k.

    f = sum_k [ data_k(x_k) + regulariser(a_k, b_k) ] + w_s/2 |S - S_0|^2 + 1/2 |L (S - S_0)|^2

The equilibria x_k are eliminated as everywhere (:mod:`solver.fitting.sensitivity`). Linearised,
expression k adds g_k . dx_k + 1/2 dx_k . C_k dx_k with dx_k = X_k dS + Z_k dp_k, p_k = (a_k, b_k).
The matrix of its pose, B_k = Z_k^T C_k Z_k + R_k, is small and dense. Eliminating dp_k as well
(variable projection: Golub and Pereyra 1973) leaves a problem in S alone with the Hessian

    sum_k X_k^T (C_k - T_k B_k^-1 T_k^T) X_k + w_s + L^T L,    T_k = C_k Z_k,

which is never formed: it is minimised on the simplex by products, each two solves with the
stiffness an expression. The published block coordinate descent solves for S and the poses in turn,
which leaves T_k out and goes a shorter way with every round.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numba as nb
import numpy as np
import scipy.linalg
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from solver.errors import InputError, SolveError
from solver.fitting import activation
from solver.fitting.face import Face, Pose, State
from solver.fitting.least_squares import DampingOptions
from solver.fitting.objective import Regulariser, Term
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics.equilibrium import PredictorOptions
from solver.model import SubjectModel
from solver.surface import Floats, Ints

# The set S lives on: every row on the unit simplex over its candidate columns.
#
# Rows are those of a CSR matrix given by its ``indptr``; values are its data (nnz,).


PASSES = 3
ITERATIONS = 10
TOLERANCE = 0.1
SIMPLEX_HALVINGS = 4


def minimise(
    values: Floats,
    gradient: Floats,
    product: Callable[[Floats], Floats],
    indptr: Ints,
    reach: float,
) -> Floats:
    """Return the values that minimise g . d + 1/2 d . H d on the simplex, d their change.

    ``gradient`` (nnz,) is g at ``values``, ``product`` multiplies by the positive definite H; no
    value moves by more than ``reach``. A few passes of conjugate gradients, each on the face that
    the last one ended on and projected afterwards (More and Toraldo 1991), not to convergence.
    """
    at, slope = values, gradient
    for _ in range(PASSES):
        free = free_entries(at, slope, indptr)

        def on_face(direction: Floats, free: NDArray[np.bool_] = free) -> Floats:
            return tangent(product(direction), free, indptr)

        system = scipy.sparse.linalg.LinearOperator(
            (len(values), len(values)), matvec=on_face, dtype=np.float64
        )
        right = -tangent(slope, free, indptr)
        step, _ = scipy.sparse.linalg.cg(system, right, rtol=TOLERANCE, maxiter=ITERATIONS)
        for halving in range(SIMPLEX_HALVINGS):
            goal = np.clip(at + 0.5**halving * step, values - reach, values + reach)
            move = project(goal, indptr) - at
            image = product(move)
            if slope @ move + 0.5 * move @ image < 0.0:
                break
        else:
            break
        at, slope = at + move, slope + image
    return at


@nb.njit(cache=True, parallel=True)
def project(values: Floats, indptr: Ints) -> Floats:
    """Return the nearest values with s >= 0 and sum 1 in every row (Held, Wolfe, Crowder 1974)."""
    out = np.empty_like(values)
    for row in nb.prange(len(indptr) - 1):
        first, last = indptr[row], indptr[row + 1]
        descending = np.sort(values[first:last])[::-1]
        total, threshold = 0.0, 0.0
        for k in range(last - first):
            total += descending[k]
            shift = (total - 1.0) / (k + 1)
            if descending[k] <= shift:
                break
            threshold = shift
        for entry in range(first, last):
            out[entry] = max(values[entry] - threshold, 0.0)
    return out


@nb.njit(cache=True, parallel=True)
def free_entries(values: Floats, gradient: Floats, indptr: Ints) -> NDArray[np.bool_]:
    """Tell which entries may move: not those at zero that the gradient pushes below it.

    The push is the gradient less its mean over the row's free entries, the multiplier of the sum.
    """
    free = np.ones(len(values), dtype=np.bool_)
    for row in nb.prange(len(indptr) - 1):
        first, last = indptr[row], indptr[row + 1]
        changed = True
        while changed:
            changed = False
            total, count = 0.0, 0
            for entry in range(first, last):
                if free[entry]:
                    total += gradient[entry]
                    count += 1
            for entry in range(first, last):
                held = values[entry] <= 0.0 and gradient[entry] * count > total
                if free[entry] and held and count > 1:
                    free[entry] = False
                    changed = True
    return free


@nb.njit(cache=True, parallel=True)
def tangent(values: Floats, free: NDArray[np.bool_], indptr: Ints) -> Floats:
    """Project onto the face's tangent: zero at entries that are not free, rows that sum to zero."""
    out = np.zeros_like(values)
    for row in nb.prange(len(indptr) - 1):
        total, count = 0.0, 0
        for entry in range(indptr[row], indptr[row + 1]):
            if free[entry]:
                total += values[entry]
                count += 1
        for entry in range(indptr[row], indptr[row + 1]):
            if free[entry]:
                out[entry] = values[entry] - total / count
    return out


# S as values on a fixed pattern, the candidates of every tet; and S of one subject for another.


def replace_values(S: sp.csr_array, values: Floats) -> sp.csr_array:
    """Return a matrix of S's pattern with other values (nnz,)."""
    return sp.csr_array((values, S.indices, S.indptr), shape=S.shape)


def transferred(S: sp.csr_array, source: SubjectModel, model: SubjectModel) -> sp.csr_array:
    """Return ``source``'s fitted S (n', m' + 1) on ``model``'s pattern, to start its fit from.

    Tet by tet where both have the template's tets, else from the nearest centroid; muscle by
    muscle by name. A tet whose candidates have no weight there keeps the model's own. Raises
    :class:`InputError` (``weights.other_muscles``) if no muscle is known to both.
    """
    own = model.weights
    tets = np.repeat(np.arange(own.shape[0]), np.diff(own.indptr))
    column = _columns(source.muscle_names, model.muscle_names)[own.indices]
    found = np.asarray(S[_counterparts(source, model)[tets], np.maximum(column, 0)]).ravel()
    values = np.where(column >= 0, found, 0.0)
    total = np.add.reduceat(values, own.indptr[:-1])[tets]
    values = np.where(total > 0.0, values, own.data)
    return replace_values(own, project(values, own.indptr))


def _columns(source: tuple[str, ...], names: tuple[str, ...]) -> Ints:
    """Return for every column of ``names`` that of ``source``, -1 where it has no such muscle."""
    numbers = {name: number for number, name in enumerate(source, start=1)}
    if not set(numbers) & set(names):
        raise InputError("weights.other_muscles", "the two subjects have no muscle in common")
    return np.array([0, *(numbers.get(name, -1) for name in names)])


def _counterparts(source: SubjectModel, model: SubjectModel) -> Ints:
    """Return for every tet of ``model`` the one of ``source`` that stands for it."""
    if np.array_equal(source.tets, model.tets):
        return np.arange(len(model.tets))
    there, here = (_centres(subject) for subject in (source, model))
    return np.asarray(cKDTree(there).query(here)[1])


def _centres(model: SubjectModel) -> Floats:
    """Return the tets' centroids in the frame of the jaw."""
    return np.asarray((model.rest[model.tets].mean(axis=1) - model.jaw.origin) @ model.jaw.axes.T)


@dataclass(frozen=True)
class JointOptions:
    """Steps on S and all poses: trust in the linear model, and the damping of S and of a pose."""

    largest_change: float = 0.3  # of an entry of S in a step
    halvings: int = 3
    damping: DampingOptions = field(default_factory=lambda: DampingOptions(1e-5, least=1e-7))
    pose_damping: DampingOptions = field(default_factory=lambda: DampingOptions(1e-2, least=1e-6))


@dataclass(frozen=True)
class GeometryProblem:
    """f: the terms and the regulariser of every expression, and the priors of S.

    ``prior`` has the values (nnz,) of S_0, ``structure`` is L (k, nnz).
    """

    face: Face
    data: Mapping[str, Term]
    regulariser: Regulariser
    w_s: float
    prior: Floats
    structure: sp.csr_array

    def value(self, S: sp.csr_array, states: Mapping[str, State]) -> float:
        """Return f at the states' estimates."""
        expressions = [self.expression_value(name, state) for name, state in states.items()]
        return sum(expressions) + self.prior_value(S.data)

    def expression_value(self, name: str, state: State) -> float:
        """Return one expression's part of f."""
        return activation.objective(self.data[name], self.regulariser, state)

    def prior_value(self, values: Floats) -> float:
        """Return S's own part of f."""
        away = values - self.prior
        unlike = self.structure @ away
        return float(0.5 * self.w_s * away @ away + 0.5 * unlike @ unlike)

    def prior_gradient(self, values: Floats) -> Floats:
        """Return the derivative of :meth:`prior_value`, (nnz,)."""
        away = values - self.prior
        return np.asarray(self.w_s * away + self.structure.T @ (self.structure @ away))


@dataclass(frozen=True)
class Iterate:
    """Where the fit is, and how far it trusts the linear models of S and of every pose."""

    S: sp.csr_array
    states: dict[str, State]
    damping: float = JointOptions().damping.start
    pose_damping: dict[str, float] = field(default_factory=dict)


def step(problem: GeometryProblem, now: Iterate, options: JointOptions | None = None) -> Iterate:
    """Return a better iterate, or the same S with the losing states settled, and more damping.

    The states are only approached, as in the fit of activations.
    """
    options = options or JointOptions()
    rule, pose_rule = options.damping, options.pose_damping
    face = problem.face.with_weights(now.S)
    damping = {name: now.pose_damping.get(name, pose_rule.start) for name in now.states}
    models = {
        name: _Linearised(problem, face, name, state, damping[name])
        for name, state in now.states.items()
    }
    change = _change(problem, now, list(models.values()), options.largest_change)
    before = problem.prior_value(now.S.data)
    for halving in range(options.halvings):
        share = 0.5**halving
        S = replace_values(now.S, now.S.data + share * change)
        trials = {name: model.trial(S, share * change, share) for name, model in models.items()}
        for name, trial in trials.items():
            damping[name] = pose_rule.adapt(damping[name], trial.ratio)
        # the priors are quadratic: what they gain is what their model says
        nearer = before - problem.prior_value(S.data)
        gain = sum(trial.gain for trial in trials.values()) + nearer
        if gain > 0.0:
            predicted = sum(trial.predicted for trial in trials.values()) + nearer
            # a step that had to be halved says how much too far the linear model reached
            grown = rule.increase(now.damping, halving)
            states = {name: trial.state for name, trial in trials.items() if trial.state}
            return Iterate(S, states, rule.adapt(grown, gain / predicted), damping)
    losing = [name for name, trial in trials.items() if trial.gain < 0.0]
    states = now.states | _settled(face, {name: now.states[name] for name in losing})
    return Iterate(now.S, states, rule.increase(now.damping, options.halvings), damping)


def _settled(face: Face, states: dict[str, State]) -> dict[str, State]:
    """Settle those states that can be: near buckling, the value at an estimate may flatter."""
    settled = {}
    for name, state in states.items():
        with contextlib.suppress(SolveError):
            settled[name] = face.solve_equilibrium(state.pose, state.x)
    return settled


def _change(
    problem: GeometryProblem, now: Iterate, models: list[_Linearised], reach: float
) -> Floats:
    """Return the change (nnz,) of S's values that minimises the damped model, poses following."""
    structure = problem.structure
    gradient = problem.prior_gradient(now.S.data)
    for model in models:
        gradient += model.gradient_by_geometry()

    def product(direction: Floats) -> Floats:
        out = (problem.w_s + now.damping) * direction + structure.T @ (structure @ direction)
        for model in models:
            out += model.product(direction)
        return np.asarray(out)

    best = minimise(now.S.data, gradient, product, now.S.indptr, reach)
    return np.asarray(best - now.S.data)


@dataclass(frozen=True)
class _Trial:
    """What a step did for one expression; no state and an infinite loss where it led too far."""

    state: State | None
    gain: float
    predicted: float

    @property
    def ratio(self) -> float:
        return self.gain / self.predicted if self.predicted > 0.0 else 0.0


class _Linearised:
    """The Gauss-Newton model of one expression at a state, its pose's part damped."""

    def __init__(
        self, problem: GeometryProblem, face: Face, name: str, state: State, damping: float
    ) -> None:
        self._problem, self._face, self._name, self._state = problem, face, name, state
        self._response = Sensitivity(face, state)
        self._jacobian = jacobian = self._response.by_pose()
        data, regulariser = problem.data[name], problem.regulariser
        gradient, curvature = data.gradient(state.estimate), data.curvature(state.estimate)
        self._by_x = gradient.ravel()[jacobian.free]
        rows = curvature[jacobian.free]
        self._curvature = rows[:, jacobian.free]
        self._touched = np.flatnonzero(np.diff(rows.indptr))
        self._coupling = self._curvature[self._touched] @ jacobian.flesh
        direct = sp.coo_array(rows[self._touched] @ jacobian.held)
        self._coupling[direct.row, direct.col] += direct.data
        self._by_pose = jacobian.adjoint(gradient) + regulariser.gradient(state.pose)
        self._hessian = jacobian.contract(curvature) + regulariser.gauss_newton(state.pose)
        units = np.diag(state.pose.layout.damping)
        self._factor = scipy.linalg.cho_factor(self._hessian + damping * units)

    def gradient_by_geometry(self) -> Floats:
        """Return f's derivative (nnz,) by S, the pose following."""
        by_x = self._by_x.copy()
        by_x[self._touched] -= self._coupling @ self._solve(self._by_pose)
        return self._response.by_geometry_adjoint(by_x)

    def product(self, change: Floats) -> Floats:
        """Return X^T (C - T B^-1 T^T) X applied to a change of S, (nnz,)."""
        flesh = self._response.flesh_by_geometry(change)
        pull = self._curvature @ flesh
        pull[self._touched] -= self._coupling @ self._solve(self._coupled(flesh))
        return self._response.by_geometry_adjoint(pull)

    def trial(self, S: sp.csr_array, change: Floats, share: float) -> _Trial:
        """Go to a new S and ``share`` of the way to the pose that goes with it."""
        problem, state = self._problem, self._state
        flesh = self._response.flesh_by_geometry(change)
        by_pose = -self._solve(self._by_pose + self._coupled(flesh))
        by_pose *= share / max(state.pose.layout.reach(by_pose), 1.0)
        pose = state.pose.add(by_pose)
        predicted = self._predicted(flesh, by_pose)
        trial = self._moved(S, flesh + self._jacobian.flesh @ by_pose, pose)
        if trial is None:
            return _Trial(None, -np.inf, predicted)
        gain = problem.expression_value(self._name, state)
        gain -= problem.expression_value(self._name, trial)
        return _Trial(trial, gain, predicted)

    def _moved(self, S: sp.csr_array, response: Floats, pose: Pose) -> State | None:
        """Approach a pose with S; settle where that is too far; None where that fails too."""
        face = self._face.with_weights(S)
        with contextlib.suppress(SolveError):
            # the next linear models, of S too, are the better for a stiffness that is that at x
            return face.newton_predict(self._state, response, pose, PredictorOptions.reach_mm)
        with contextlib.suppress(SolveError):
            return face.predict_and_solve(self._state, response, pose)
        return None

    def _predicted(self, flesh: Floats, by_pose: Floats) -> float:
        """Return what the undamped model gains by a change of the flesh and of the pose."""
        slope = self._by_x @ flesh + self._by_pose @ by_pose
        bend = flesh @ (self._curvature @ flesh) + by_pose @ (self._hessian @ by_pose)
        return float(-slope - 0.5 * bend - by_pose @ self._coupled(flesh))

    def _coupled(self, flesh: Floats) -> Floats:
        return np.asarray(self._coupling.T @ flesh[self._touched])

    def _solve(self, right: Floats) -> Floats:
        return np.asarray(scipy.linalg.cho_solve(self._factor, right))


# The symmetric option: muscles of the left and right change alike, as far as the tets allow.
#
# A tet mesh is not its own mirror image, and neither is a person. So nothing is forced: the prior
# (w_m/2) sum (ds_ij - ds_i'j')^2 asks the *changes* ds of S from its start, which has the mesh's
# own asymmetry, to be alike at the tet i' nearest to the mirrored centroid of tet i and the muscle
# j' of the other side. The mirror is the jaw frame's middle plane.


OTHER_SIDE = {"left": "right", "right": "left", "l": "r", "r": "l"}

MIRROR_REACH_MM = 4.0
"""A tet further than this from its mirrored place has no counterpart."""


def mirror_structure(model: SubjectModel, w_m: float) -> sp.csr_array:
    """Return L (k, nnz), so that 1/2 |L ds|^2 is the prior; entries without counterpart are free.

    Raises :class:`InputError` (``model.no_sides``) if no muscle's name tells its side.
    """
    S = model.weights
    numbers = sp.csr_array((np.arange(1, S.nnz + 1), S.indices, S.indptr), shape=S.shape)
    tets = np.repeat(np.arange(S.shape[0]), np.diff(S.indptr))
    tet, muscle = mirrored_tets(model)[tets], mirrored_muscles(model.muscle_names)[S.indices]
    found = np.asarray(numbers[np.maximum(tet, 0), muscle]).ravel() - 1
    own = np.arange(S.nnz)
    paired = np.flatnonzero((tet >= 0) & (found >= 0) & (found != own))
    root = np.full(len(paired), np.sqrt(w_m))
    rows = np.arange(len(paired))
    return sp.csr_array(
        (
            np.concatenate([root, -root]),
            (np.concatenate([rows, rows]), np.concatenate([paired, found[paired]])),
        ),
        shape=(len(paired), S.nnz),
    )


def mirrored_muscles(names: tuple[str, ...]) -> Ints:
    """Return for every column of S the column of the other side, for those in the middle their own.

    The sides are the words left, right, l and r of a name.
    """
    words = [tuple(re.split(r"[\s_]+", name.lower())) for name in names]
    columns = {name: number for number, name in enumerate(words, start=1)}
    swapped = [tuple(OTHER_SIDE.get(word, word) for word in name) for name in words]
    if swapped == words:
        raise InputError("model.no_sides", "no muscle's name says left or right: nothing mirrors")
    others = [columns.get(name, number) for number, name in enumerate(swapped, start=1)]
    return np.array([0, *others])


def mirrored_tets(model: SubjectModel) -> Ints:
    """Return for every tet the nearest to its mirror image, -1 if none is near."""
    centres = model.rest[model.tets].mean(axis=1)
    distance, nearest = cKDTree(centres).query(_mirrored(model, centres))
    return np.where(distance <= MIRROR_REACH_MM, nearest, -1)


def _mirrored(model: SubjectModel, points: Floats) -> Floats:
    across = model.jaw.axes[0]
    return np.asarray(points - 2.0 * np.outer((points - model.jaw.origin) @ across, across))
