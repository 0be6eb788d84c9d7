"""The sliders: every muscle's contraction, the jaw's ways, what else each expression uses.

All are numbers from 0 to 1 that change (a, b) linearly. A muscle's slider contracts it along its
fibres. The jaw has two, one each way, for each of its degrees of freedom that is used. One number
per muscle cannot tell all of a fit with six: what is left of each expression is a control of its
own, so that every fit can be reached. Their equilibria are each found from the nearest one known.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg
import scipy.optimize

from solver.drawing.head import both_sides
from solver.errors import SolveError
from solver.fitting.activation import rest_curvature
from solver.fitting.controls import JAW_UNITS
from solver.fitting.face import Face, Pose, PosedFace
from solver.fitting.sensitivity import Sensitivity
from solver.fitting.stretches import FROBENIUS, fibre_tensors, shorten
from solver.mechanics.boundary import JAW_FREEDOM, jaw_jacobian
from solver.mechanics.equilibrium import Equilibrium
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.newton import Factorization
from solver.rig.rig import ExpressionFit
from solver.surface import Floats

# What a muscle's slider does: the muscle shortens along its fibres, as muscles do.
#
# A fit has six numbers a muscle, and uses them freely: seen by itself, a fitted activation may push
# where the muscle would pull. So a slider is not the fit's but the muscle's: C_j, its contraction.
# The amounts of an expression's activations A_e (m, 6), as differences from rest, are those that
# come nearest to it,
#
#     min over 0 <= c <= 1 of |sum_j c_j C_j - A_e|^2 in the norm J^T J + w I,
#
# J being the skin's linear response at rest: what matters of an activation is what is seen of it.
# The small w keeps what is hardly seen near the fits too.


@dataclass(frozen=True)
class SliderOptions:
    """Ends of the sliders, and weights that split fits between them."""

    # length to which a slider at 1 shortens a muscle's fibres: well within what muscles can (half:
    # solver.rig.certificate.MUSCLE_SOURCE), and on the straight line from rest to there the
    # muscle's volume is never off by more than 5 %
    full_stretch: float = 0.6
    unseen: float = 1e-2  # the weight w, mm^2
    jitter: float = 1e-9  # part of the mean diagonal that makes a Gram matrix definite
    margin: float = 1.25  # the jaw's sliders go so many times as far as the fitted expressions
    least_opening: float = 0.2  # rad, by which the jaw opens at least
    # way of the condyles per radian of opening (Muto and Kanazawa 1996: 20.5 mm and 39.1 degrees)
    condyle_path_mm: float = 30.0
    least_jaw_mm: float = 0.3  # motion of the chin from which on a degree of freedom is used


def nearest_amounts(
    activations: Floats,
    contractions: Floats,
    seen: Floats,
    options: SliderOptions = SliderOptions(),
) -> Floats:
    """Return the amounts (e, k), from 0 to 1, that come nearest to fitted activations.

    ``activations`` (e, 6 m) are differences from rest, ``contractions`` (6 m, k) the changes at 1,
    ``seen`` (6 m, 6 m) is J^T J in mm^2.
    """
    if not contractions.size:
        return np.zeros((len(activations), 0))
    norm = seen + options.unseen * np.diag(np.tile(FROBENIUS, len(seen) // 6))
    gram = contractions.T @ norm @ contractions
    jitter = np.eye(len(gram)) * options.jitter * np.trace(gram) / len(gram)
    root = np.linalg.cholesky(gram + jitter).T
    right = scipy.linalg.solve_triangular(root, contractions.T @ norm @ activations.T, trans="T")
    return np.array([scipy.optimize.lsq_linear(root, each, (0.0, 1.0)).x for each in right.T])


# b's entries, and where each leads when it grows and when it falls
JAW_WAYS = (
    ("jaw opens", "jaw closes"),
    ("jaw turns left", "jaw turns right"),
    ("jaw moves left", "jaw moves right"),
    ("jaw moves up", "jaw moves down"),
    ("jaw moves forward", "jaw moves back"),
)

Kind = Literal["muscle", "jaw", "expression"]


@dataclass(frozen=True)
class Control:
    """One slider; ``muscle`` is the name of the muscle that a control of that kind contracts."""

    name: str
    kind: Kind
    title: str
    muscle: str | None = None


@dataclass(frozen=True)
class Sliders:
    """The k sliders."""

    each: tuple[Control, ...]
    rest: Pose
    directions: Floats  # (6 m + 5, k) change of (a, b) from ``rest`` that each makes at 1
    presets: dict[str, Floats]  # values (k,) of every fitted expression

    def __len__(self) -> int:
        """Return k."""
        return len(self.each)

    def pose(self, values: Floats) -> Pose:
        """Return the pose of slider ``values`` (k,)."""
        return self.rest.add(self.directions @ values)

    def of_kind(self, kind: Kind) -> list[int]:
        """Return the numbers of the controls of a kind."""
        return [number for number, control in enumerate(self.each) if control.kind == kind]


def controls_of(
    face: Face, fits: Sequence[ExpressionFit], options: SliderOptions = SliderOptions()
) -> Sliders:
    """Return the controls of a face with one fitted expression or more."""
    layout = face.layout
    in_a, in_b = layout["activations"], layout["jaw"]
    fitted = np.array([Pose(fit.activations, fit.jaw).vector() for fit in fits]) - layout.rest
    muscles, changes = _muscles(face, options.full_stretch)
    # the curvature of a mean square is twice J^T J
    seen = 0.5 * rest_curvature(face)[in_a, in_a]
    contracted = nearest_amounts(fitted[:, in_a], changes, seen, options)
    jaws, ways, opened = _jaw(fitted[:, in_b], options)
    directions = np.zeros((layout.size, len(muscles) + len(jaws)))
    directions[in_a, : len(muscles)] = changes
    directions[in_b, len(muscles) :] = ways
    values = np.hstack([contracted, opened])
    left = fitted - values @ directions.T
    others = tuple(
        Control(f"{fit.name}, the rest", "expression", f"What else {fit.name} uses") for fit in fits
    )
    whole = np.hstack([values, np.eye(len(fits))])
    return Sliders(
        (*muscles, *jaws, *others),
        face.rest_pose(),
        np.hstack([directions, left.T]),
        {fit.name: row for fit, row in zip(fits, whole, strict=True)},
    )


def _muscles(face: Face, full_stretch: float) -> tuple[list[Control], Floats]:
    """Return controls and changes of a (6 m, .) of the muscles that have fibres in S."""
    model, count = face.model, face.model.muscle_count
    tensors = fibre_tensors(model, face.flesh.volumes, face.S)
    kept = np.flatnonzero(np.isfinite(tensors).all(axis=(1, 2)))
    changes = np.zeros((count, 6, len(kept)))
    for column, muscle in enumerate(kept):
        changes[muscle, :, column] = shorten(tensors[muscle], full_stretch) - IDENTITY
    names = [model.muscle_names[muscle] for muscle in kept]
    return [Control(name, "muscle", name, name) for name in names], changes.reshape(6 * count, -1)


def _jaw(fitted: Floats, options: SliderOptions) -> tuple[list[Control], Floats, Floats]:
    """Return the jaw's controls, their changes of b (5, .) and the values (e, .) of ``fitted``."""
    along = np.eye(5)
    # an opening jaw takes its condyles along: the fits count from there
    along[4, 0] = options.condyle_path_mm
    places = fitted @ np.linalg.inv(along).T
    listed, columns, values = [], [], []
    for axis, ways in enumerate(JAW_WAYS):
        for sign, title in zip((1.0, -1.0), ways, strict=True):
            there = np.maximum(sign * places[:, axis], 0.0)
            least = options.least_opening if title == "jaw opens" else 0.0
            most = max(options.margin * there.max(initial=0.0), least)
            if most * JAW_UNITS[axis] >= options.least_jaw_mm:
                listed.append(Control(title.replace(" ", "_"), "jaw", title.capitalize()))
                columns.append(sign * most * along[:, axis])
                values.append(there / most)
    return listed, np.array(columns).T, np.array(values).T


# Poses of the sliders that are simulated: those that people look at, and some between.


@dataclass(frozen=True)
class PoseCounts:
    """Numbers of mixed poses by sort."""

    plausible: int
    pairs: int
    variations: int
    blends: int


@dataclass(frozen=True)
class SampleOptions:
    """Poses to learn from, and those to measure the error with, beside every control alone."""

    levels: tuple[float, float] = (0.5, 1.0)  # of a control alone, and of a fitted expression
    learn: PoseCounts = PoseCounts(plausible=48, pairs=24, variations=24, blends=12)
    measure: PoseCounts = PoseCounts(plausible=16, pairs=8, variations=8, blends=6)
    pair: tuple[float, float] = (0.3, 1.0)  # values of a pair
    muscles: int = 8  # of a plausible pose, both sides counting as one
    excitation: tuple[float, float] = (0.05, 0.6)  # of those muscles
    asymmetry: float = 0.1  # difference of the other side's, at most
    opening: float = 0.6  # of the jaw, at most


@dataclass(frozen=True)
class Slid:
    """Slider ``values`` (k,); ``about`` is the control or the expression that a pose is made of."""

    sort: str
    values: Floats
    about: str | None = None


def poses_to_learn(
    controls: Sliders, seed: int, options: SampleOptions = SampleOptions()
) -> list[Slid]:
    """Return the poses that the preview is made from, the most important first."""
    rng = np.random.default_rng([seed, 0])
    fitted = [
        Slid("expression", level * values, name)
        for name, values in controls.presets.items()
        for level in reversed(options.levels)
    ]
    numbers = range(len(controls))
    alone = [_alone(controls, number, level) for number in numbers for level in options.levels]
    return [*fitted, *alone, *_mix(controls, rng, options.learn, options)]


def poses_to_measure(
    controls: Sliders, seed: int, options: SampleOptions = SampleOptions()
) -> list[Slid]:
    """Return other poses: every control alone, and mixed ones of all sorts."""
    rng = np.random.default_rng([seed, 1])
    levels = rng.uniform(min(options.levels) / 2, max(options.levels), len(controls))
    alone = [_alone(controls, number, level) for number, level in enumerate(levels)]
    return [*_mix(controls, rng, options.measure, options), *alone]


def _alone(controls: Sliders, number: int, level: float) -> Slid:
    """Return a pose of one control; what is left of an expression, with what its muscles do."""
    control = controls.each[number]
    values = np.zeros(len(controls))
    if control.kind == "expression":
        values = next(each for each in controls.presets.values() if each[number]).copy()
        level = 1.0 - level
    values[number] = level
    return Slid("alone", values, control.name)


def _mix(
    controls: Sliders, rng: np.random.Generator, counts: PoseCounts, options: SampleOptions
) -> Iterator[Slid]:
    for _ in range(counts.plausible):
        yield Slid("plausible", plausible_values(controls, rng, options))
    fitted = np.array(list(controls.presets.values()))
    # how much the expressions use two muscles or ways of the jaw together, (k, k)
    own = fitted.copy()
    own[:, controls.of_kind("expression")] = 0.0
    used = np.triu(own.T @ own, 1)
    for _ in range(counts.pairs if used.any() else 0):
        pair = rng.choice(used.size, p=used.ravel() / used.sum())
        values = np.zeros(len(controls))
        values[list(np.unravel_index(pair, used.shape))] = rng.uniform(*options.pair, 2)
        yield Slid("pair", values)
    changeable = controls.of_kind("muscle") + controls.of_kind("jaw")
    for _ in range(counts.variations):
        values = fitted[rng.integers(len(fitted))].copy()
        values[rng.choice(changeable)] = rng.uniform()
        yield Slid("variation", values)
    for _ in range(counts.blends if len(fitted) > 1 else 0):
        part = rng.uniform()
        one, other = fitted[rng.choice(len(fitted), 2, replace=False)]
        yield Slid("blend", part * one + (1.0 - part) * other)


def plausible_values(
    controls: Sliders, rng: np.random.Generator, options: SampleOptions = SampleOptions()
) -> Floats:
    """Return a random pose that faces take: some muscles of both sides alike, the jaw open."""
    kinds: dict[str, list[int]] = {}
    for number in controls.of_kind("muscle"):
        kinds.setdefault(both_sides(controls.each[number].name), []).append(number)
    values = np.zeros(len(controls))
    for kind in rng.choice(list(kinds), min(options.muscles, len(kinds)), replace=False):
        excitation = rng.uniform(*options.excitation)
        for number in kinds[str(kind)]:
            other = rng.uniform(-options.asymmetry, options.asymmetry)
            values[number] = max(excitation + other, 0.0)
    # the first of the jaw's controls opens it
    values[controls.of_kind("jaw")[0]] = rng.uniform(0.0, options.opening)
    return values


@dataclass(frozen=True)
class Sample:
    """A pose of the sliders with its equilibrium: vertices x (p, 3) and the skin (n, 3)."""

    slid: Slid
    x: Floats
    skin: Floats


# called with the number of poses that have been tried
Listener = Callable[[int], None]


class SliderSolver:
    """Finds equilibria of a face's sliders; ``fitted`` (p, 3) are those of whole expressions."""

    def __init__(
        self, face: Face, controls: Sliders, rest: PosedFace, fitted: Mapping[str, Floats]
    ) -> None:
        self._face, self._controls = face, controls
        self._last, self._last_values = rest, np.zeros(len(controls))
        self._known = [(self._last_values, rest.x)]
        self._known += [(controls.presets[name], x) for name, x in fitted.items()]

    def solve(self, poses: Sequence[Slid], deadline: float, listen: Listener) -> list[Sample]:
        """Return the samples of ``poses`` within reach, begun by ``deadline`` (monotonic time)."""
        samples = []
        for number, slid in enumerate(poses):
            if time.monotonic() > deadline:
                break
            pose = self._controls.pose(slid.values)
            with suppress(SolveError):
                state = self._face.continuation(self._near(slid.values), pose)
                self._last, self._last_values = state, slid.values
                skin = self._face.whole_skin(state.x, state.pose.b)
                samples.append(Sample(slid, state.x, skin))
                self._known.append((slid.values, state.x))
            listen(number + 1)
        return samples

    def _near(self, values: Floats) -> PosedFace:
        """Return the nearest state; only the last one still has its factorised Hessian."""
        distances = [float(np.linalg.norm(values - known)) for known, _ in self._known]
        nearest, x = self._known[int(np.argmin(distances))]
        if nearest is self._last_values:
            return self._last
        return state_at(self._face, self._controls, nearest, x)


def state_at(face: Face, controls: Sliders, values: Floats, x: Floats) -> PosedFace:
    """Return the state of slider ``values`` (k,) with its equilibrium ``x`` (p, 3)."""
    pose = controls.pose(values)
    factor = Factorization(face.flesh, face.linear, x, face.flesh_controls(pose.a))
    return PosedFace(pose, Equilibrium(x, x, factor, 0.0, 0))


# The skin's response to the sliders at a sample: a whole derivative for one factorisation.


class Responses:
    """Derivatives by the sliders of the skin's inner products with ``modes`` (r, n, 3)."""

    def __init__(self, face: Face, controls: Sliders, modes: Floats) -> None:
        self._face, self._controls = face, controls
        model = face.model
        count = len(modes)
        moved = modes[:, model.embedded].transpose(1, 0, 2).reshape(len(model.embedded), -1)
        by_vertex = (model.embedding.T @ moved).reshape(-1, count, 3)
        self._of_x = np.ascontiguousarray(by_vertex.transpose(1, 0, 2).reshape(count, -1))
        self._of_mandible = modes[:, model.attached_mandible].reshape(count, -1)

    def at(self, sample: Sample) -> Floats | None:
        """Return the derivatives (r, k) at a sample; None where the flesh is about to buckle."""
        face, model, directions = self._face, self._face.model, self._controls.directions
        state = state_at(face, self._controls, sample.slid.values, sample.x)
        if not state.equilibrium.minimum:
            return None
        by_x = Sensitivity(face, state).motions_along(directions)
        out = self._of_x @ by_x.reshape(self._of_x.shape[1], -1)
        points = model.skin.vertices[model.attached_mandible]
        attached = jaw_jacobian(model.jaw, points, state.pose.b).reshape(-1, JAW_FREEDOM)
        return np.asarray(out + self._of_mandible @ (attached @ directions[face.layout["jaw"]]))
