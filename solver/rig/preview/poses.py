"""Poses of the sliders that a reduced skin is made from and measured on, and their equilibria.

They are those that people look at, and some between. Each equilibrium is found from the nearest one
that is known.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from typing_extensions import override

from solver.anatomy.template import split_side
from solver.drawing.head import both_sides
from solver.errors import SolveError
from solver.fitting.face import Face, PosedFace
from solver.fitting.sensitivity import Sensitivity
from solver.mechanics.equilibrium import Equilibrium
from solver.mechanics.newton import Factorization
from solver.rig.preview.sliders import Kind, Sliders
from solver.surface import Floats


@dataclass(frozen=True)
class PoseCounts:
    """Numbers of mixed poses by sort."""

    plausible: int
    pairs: int
    variations: int
    blends: int


@dataclass(frozen=True)
class Slid:
    """Slider ``values`` (k,); ``about`` is the control or the expression that a pose is made of."""

    sort: str
    values: Floats
    about: str | None = None


class SamplePlan(Protocol):
    """Poses of sliders that a skin is made from, and others that its error is measured on."""

    def to_learn(self, controls: Sliders, seed: int) -> list[Slid]:
        """Return the poses to learn from, the most important first."""

    def to_measure(self, controls: Sliders, seed: int) -> list[Slid]:
        """Return other poses."""


@dataclass(frozen=True)
class SampleOptions(SamplePlan):
    """Poses of every control alone, and mixed ones of all sorts."""

    levels: tuple[float, float] = (0.5, 1.0)  # of a control alone, and of a fitted expression
    learn: PoseCounts = PoseCounts(plausible=48, pairs=24, variations=24, blends=12)
    measure: PoseCounts = PoseCounts(plausible=16, pairs=8, variations=8, blends=6)
    pair: tuple[float, float] = (0.3, 1.0)  # values of a pair
    muscles: int = 8  # of a plausible pose, both sides counting as one
    excitation: tuple[float, float] = (0.05, 0.6)  # of those muscles
    asymmetry: float = 0.1  # difference of the other side's, at most
    opening: float = 0.6  # of the jaw, at most

    @override
    def to_learn(self, controls: Sliders, seed: int) -> list[Slid]:
        numbers = range(len(controls))
        alone = [_alone(controls, number, level) for number in numbers for level in self.levels]
        mixed = _mix(controls, np.random.default_rng([seed, 0]), self.learn, self)
        return [*_presets(controls, self.levels), *alone, *mixed]

    @override
    def to_measure(self, controls: Sliders, seed: int) -> list[Slid]:
        rng = np.random.default_rng([seed, 1])
        levels = rng.uniform(min(self.levels) / 2, max(self.levels), len(controls))
        alone = [_alone(controls, number, level) for number, level in enumerate(levels)]
        return [*_mix(controls, rng, self.measure, self), *alone]


def _presets(controls: Sliders, levels: Sequence[float]) -> list[Slid]:
    """Return every expression at the levels, the greatest first."""
    return [
        Slid("expression", level * values, name)
        for name, values in controls.presets.items()
        for level in reversed(levels)
    ]


def _alone(controls: Sliders, number: int, level: float) -> Slid:
    """Return a pose of one control at a level.

    The control of an expression is what is left of it beside its muscles: these are at their full
    amounts while it goes from 1 to 0.
    """
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
    values = _alike(controls, "muscle", rng, options.muscles, options.excitation, options.asymmetry)
    # the first of the jaw's controls opens it
    values[controls.of_kind("jaw")[0]] = rng.uniform(0.0, options.opening)
    return values


def _alike(
    controls: Sliders,
    kind: Kind,
    rng: np.random.Generator,
    count: int,
    amounts: tuple[float, float],
    asymmetry: float,
) -> Floats:
    """Return random values (k,) of one kind of controls, similar on both sides of the face."""
    sides: dict[str, list[int]] = {}
    for number in controls.of_kind(kind):
        name = controls.each[number].name
        bare = both_sides(name) if kind == "muscle" else split_side(name)[0]
        sides.setdefault(bare, []).append(number)
    values = np.zeros(len(controls))
    for name in rng.choice(list(sides), min(count, len(sides)), replace=False):
        amount = rng.uniform(*amounts)
        for number in sides[str(name)]:
            values[number] = max(amount + rng.uniform(-asymmetry, asymmetry), 0.0)
    return values


@dataclass(frozen=True)
class ShapeSampleOptions(SamplePlan):
    """Poses of a template's expressions: each alone, and mixtures of them."""

    levels: tuple[float, float] = (0.5, 1.0)  # of an expression alone
    learn: int = 150
    measure: int = 30
    shapes: tuple[int, int] = (3, 8)  # in a mixture, both sides counting as one
    amount: tuple[float, float] = (0.05, 0.8)
    asymmetry: float = 0.15  # difference of a side's amount, at most

    @override
    def to_learn(self, controls: Sliders, seed: int) -> list[Slid]:
        mixed = self._mix(controls, np.random.default_rng([seed, 0]), self.learn)
        return [*_presets(controls, self.levels), *mixed]

    @override
    def to_measure(self, controls: Sliders, seed: int) -> list[Slid]:
        return self._mix(controls, np.random.default_rng([seed, 1]), self.measure)

    def _mix(self, controls: Sliders, rng: np.random.Generator, count: int) -> list[Slid]:
        least, most = self.shapes
        found = []
        for _ in range(count):
            shapes = int(rng.integers(least, most + 1))
            ends = self.amount, self.asymmetry
            found.append(Slid("mixture", _alike(controls, "expression", rng, shapes, *ends)))
        return found


@dataclass(frozen=True)
class PoseSample:
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
        self._face = face
        self._controls = controls
        self._last = rest
        self._last_values = np.zeros(len(controls))
        self._known = [(self._last_values, rest.x)]
        self._known += [(controls.presets[name], x) for name, x in fitted.items()]

    def solve(self, poses: Sequence[Slid], deadline: float, listen: Listener) -> list[PoseSample]:
        """Return the samples of ``poses`` within reach, begun by ``deadline`` (monotonic time)."""
        samples = []
        for number, slid in enumerate(poses):
            if time.monotonic() > deadline:
                break
            pose = self._controls.pose(slid.values)
            with suppress(SolveError):
                state = self._face.continuation(self._near(slid.values), pose)
                self._last = state
                self._last_values = slid.values
                skin = self._face.whole_skin(state.x, state.pose.b)
                samples.append(PoseSample(slid, state.x, skin))
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
        self._face = face
        self._controls = controls
        model = face.model
        count = len(modes)
        moved = modes[:, model.embedded].transpose(1, 0, 2).reshape(len(model.embedded), -1)
        by_vertex = (model.embedding.T @ moved).reshape(-1, count, 3)
        self._of_x = np.ascontiguousarray(by_vertex.transpose(1, 0, 2).reshape(count, -1))
        self._of_mandible = modes[:, model.attached_mandible].reshape(count, -1)

    def at(self, sample: PoseSample) -> Floats | None:
        """Return the derivatives (r, k) at a sample; None where the flesh is about to buckle."""
        face = self._face
        model = self._face.model
        directions = self._controls.directions
        state = state_at(face, self._controls, sample.slid.values, sample.x)
        if not state.equilibrium.minimum:
            return None
        by_x = Sensitivity(face, state).motions_along(directions)
        out = self._of_x @ by_x.reshape(self._of_x.shape[1], -1)
        points = model.skin.vertices[model.attached_mandible]
        attached = face.jaw.jacobian(points, state.pose.b)
        by_jaw = attached.reshape(-1, attached.shape[2]) @ directions[face.layout.joint_places]
        return np.asarray(out + self._of_mandible @ by_jaw)
