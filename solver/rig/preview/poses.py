"""Which poses of the sliders are simulated: those that people look at, and some between."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from solver.drawing.colours import both_sides
from solver.rig.preview.controls import Controls
from solver.surface import Floats

LEVELS = (0.5, 1.0)
"""Of a control alone, and of a fitted expression."""

PAIRS, VARIATIONS, BLENDS, PLAUSIBLE = 24, 24, 12, 48
"""Poses of those sorts to learn from."""

UNSEEN_PAIRS, UNSEEN_VARIATIONS, UNSEEN_BLENDS, UNSEEN_PLAUSIBLE = 8, 8, 6, 16
"""And to measure the error with, beside every control alone."""

TOGETHER = (0.3, 1.0)
"""Values of a pair."""

EXCITED = 8
"""Muscles of a plausible pose, both sides counting as one."""

EXCITATION, ASYMMETRY = (0.05, 0.6), 0.1
OPENED = 0.6
"""Values in a plausible pose: of its muscles, the other side's difference, of the jaw at most."""


@dataclass(frozen=True)
class Slid:
    """Slider ``values`` (k,); ``about`` is the control or the expression that a pose is made of."""

    sort: str
    values: Floats
    about: str | None = None


def learned_from(controls: Controls, seed: int) -> list[Slid]:
    """Return the poses that the preview is made from, the most important first."""
    rng = np.random.default_rng([seed, 0])
    return [
        *(
            Slid("expression", level * values, name)
            for name, values in controls.presets.items()
            for level in reversed(LEVELS)
        ),
        *(_alone(controls, number, level) for number in range(len(controls)) for level in LEVELS),
        *_mixed(controls, rng, PLAUSIBLE, PAIRS, VARIATIONS, BLENDS),
    ]


def measured_on(controls: Controls, seed: int) -> list[Slid]:
    """Return other poses: every control alone, and mixed ones of all sorts."""
    rng = np.random.default_rng([seed, 1])
    levels = rng.uniform(min(LEVELS) / 2, max(LEVELS), len(controls))
    alone = [_alone(controls, number, level) for number, level in enumerate(levels)]
    mixed = _mixed(controls, rng, UNSEEN_PLAUSIBLE, UNSEEN_PAIRS, UNSEEN_VARIATIONS, UNSEEN_BLENDS)
    return [*mixed, *alone]


def _alone(controls: Controls, number: int, level: float) -> Slid:
    """Return a pose of one control; what is left of an expression, with what its muscles do."""
    control = controls.each[number]
    values = np.zeros(len(controls))
    if control.kind == "expression":
        values = next(each for each in controls.presets.values() if each[number]).copy()
        level = 1.0 - level
    values[number] = level
    return Slid("alone", values, control.name)


def _mixed(
    controls: Controls,
    rng: np.random.Generator,
    plausible: int,
    pairs: int,
    variations: int,
    blends: int,
) -> Iterator[Slid]:
    for _ in range(plausible):
        yield Slid("plausible", plausible_values(controls, rng))
    used = _used_together(controls)
    for _ in range(pairs if used.any() else 0):
        pair = rng.choice(used.size, p=used.ravel() / used.sum())
        values = np.zeros(len(controls))
        values[list(np.unravel_index(pair, used.shape))] = rng.uniform(*TOGETHER, 2)
        yield Slid("pair", values)
    fitted = np.array(list(controls.presets.values()))
    changeable = controls.of_kind("muscle") + controls.of_kind("jaw")
    for _ in range(variations):
        values = fitted[rng.integers(len(fitted))].copy()
        values[rng.choice(changeable)] = rng.uniform()
        yield Slid("variation", values)
    for _ in range(blends if len(fitted) > 1 else 0):
        part = rng.uniform()
        one, other = fitted[rng.choice(len(fitted), 2, replace=False)]
        yield Slid("blend", part * one + (1.0 - part) * other)


def plausible_values(controls: Controls, rng: np.random.Generator) -> Floats:
    """Return a random pose that faces take: some muscles of both sides alike, the jaw open."""
    kinds: dict[str, list[int]] = {}
    for number in controls.of_kind("muscle"):
        kinds.setdefault(both_sides(controls.each[number].name), []).append(number)
    values = np.zeros(len(controls))
    for kind in rng.choice(list(kinds), min(EXCITED, len(kinds)), replace=False):
        excitation = rng.uniform(*EXCITATION)
        for number in kinds[str(kind)]:
            values[number] = max(excitation + rng.uniform(-ASYMMETRY, ASYMMETRY), 0.0)
    # the first of the jaw's controls opens it
    values[controls.of_kind("jaw")[0]] = rng.uniform(0.0, OPENED)
    return values


def _used_together(controls: Controls) -> Floats:
    """Return how much the expressions use two muscles or ways of the jaw together, (k, k)."""
    fitted = np.array(list(controls.presets.values()))
    fitted[:, controls.of_kind("expression")] = 0.0
    return np.triu(fitted.T @ fitted, 1)
