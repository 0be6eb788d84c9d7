"""Mixtures of a template's shapes that controls are learned from, drawn at random."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from solver.anatomy.template import CORRECTED
from solver.scans.live_link import ARKIT_NAMES
from solver.scans.openface import shapes_of_units
from solver.surface import Floats
from solver.templates.ict_facekit import arkit_source

LEVELS = (0.25, 0.5, 0.75, 1.0)  # of each shape alone
MixtureKind = Literal["rest", "units", "few", "dense"]


@dataclass(frozen=True)
class WalkOptions:
    """Mixtures that walks go to, and the stops on their way."""

    step: float = 1.0  # greatest sum of the weights' changes from stop to stop of a walk in steps
    stops: int = 120  # of a walk
    in_steps: int = 12  # walks; the others jump ...
    choices: int = 4  # ... to one of so many mixtures of a kind, by its leverage
    refit_above_mm: float = 0.3  # mean distance of a fit to its mixture, above which it goes on
    # parts of the mixtures that are of action units, alike on both sides, and of many shapes
    units: float = 0.5
    dense: float = 0.2
    most_units: int = 6
    most_shapes: int = 6  # of a mixture that is not dense
    most_dense: int = 16
    opens_jaw: float = 0.4  # part of the mixtures of shapes in which the jaw opens as well
    alike: float = 0.5  # part of them in which both sides of a shape move alike
    rest: float = 0.03  # part of the mixtures that are rest


@dataclass(frozen=True, eq=False)
class Mixtures:
    """Weights (e,) that shapes ``names`` can have together, drawn at random."""

    names: tuple[str, ...]
    options: WalkOptions = WalkOptions()

    def draw(self, random: np.random.Generator, kind: MixtureKind | None = None) -> Floats:
        """Return weights (e,) from 0 to 1, of a kind or of any."""
        given = self.options
        weights = np.zeros(len(self.names))
        kind = kind or self.draw_kind(random)
        if kind == "rest":
            return weights
        if kind == "units":
            return self.of_units(self.draw_units(random))
        dense = kind == "dense"
        most = min(given.most_dense if dense else given.most_shapes, len(self.names))
        least = min(given.most_shapes, most) if dense else 1
        count = int(random.integers(least, most + 1))
        chosen = random.choice(len(self.names), count, replace=False)
        # many shapes at once are rarely strong
        weights[chosen] = random.beta(1.0, 2.0 if dense else 1.0, count)
        if random.random() < given.alike:
            for name, other in self._sides:
                weights[other] = weights[name]
        if "jawOpen" in self.names and random.random() < given.opens_jaw:
            weights[self.names.index("jawOpen")] = random.random()
        return self.possible(weights)

    def draw_kind(self, random: np.random.Generator) -> MixtureKind:
        """Return a kind of mixture."""
        given = self.options
        drawn = random.random()
        if drawn < given.rest:
            return "rest"
        if drawn < given.rest + given.units:
            return "units"
        return "dense" if drawn > 1.0 - given.dense else "few"

    def draw_units(self, random: np.random.Generator, least: int = 1) -> Floats:
        """Return intensities (17,) from 0 to 1 of so many action units or more."""
        moving = np.flatnonzero(self._units.any(axis=1))
        count = int(random.integers(least, self.options.most_units + 1))
        chosen = random.choice(moving, min(count, len(moving)), replace=False)
        intensities = np.zeros(len(self._units))
        intensities[chosen] = random.random(len(chosen))
        return intensities

    def of_units(self, intensities: Floats) -> Floats:
        """Return the weights (e,) of action units (17,), both sides alike."""
        return self.possible(intensities @ self._units)

    def possible(self, weights: Floats) -> Floats:
        """Return weights from 0 to 1, a corrective's no greater than that of what it corrects."""
        weights = np.clip(weights, 0.0, 1.0)
        for name, corrected in CORRECTED.items():
            if name in self.names:
                with_it = weights[self.names.index(corrected)] if corrected in self.names else 0.0
                weights[self.names.index(name)] = min(weights[self.names.index(name)], with_it)
        return weights

    def alone(self) -> list[Floats]:
        """Return each shape by itself at several levels, a corrective on what it corrects."""
        found = []
        for number, name in enumerate(self.names):
            weights = np.zeros(len(self.names))
            weights[number] = 1.0
            if CORRECTED.get(name) in self.names:
                weights[self.names.index(CORRECTED[name])] = 1.0
            found += [self.possible(level * weights) for level in LEVELS]
        return found

    @property
    def _units(self) -> Floats:
        """Weights (17, e) of each action unit at full intensity; some move nothing."""
        columns = [ARKIT_NAMES.index(arkit_source(name)) for name in self.names]
        return shapes_of_units()[:, columns]

    @property
    def _sides(self) -> list[tuple[int, int]]:
        """Places of the left and the right one of each shape that has both."""
        pairs = {name: name.removesuffix("Left") + "Right" for name in self.names}
        return [
            (self.names.index(name), self.names.index(other))
            for name, other in pairs.items()
            if name.endswith("Left") and other in self.names
        ]
