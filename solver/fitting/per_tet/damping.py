"""Levenberg-Marquardt damping for thousands of activations, each trusted by itself."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from solver.fitting import stretches
from solver.fitting.controls import JAW_UNITS
from solver.fitting.least_squares import DampingOptions
from solver.surface import Floats


@dataclass(frozen=True)
class PerTetDamping:
    """Trust in the linear model, and the rules of the tets' dampings and of the jaw's."""

    largest_step: float = 0.5  # a tet's change |dS(a_i)|, relative
    largest_jaw_step: float = 2.0  # mm
    tets: DampingOptions = field(default_factory=lambda: DampingOptions(1.0, least=1e-7, grow=8.0))
    jaw: DampingOptions = field(default_factory=lambda: DampingOptions(1e-2, least=1e-7, grow=8.0))
    refused: float = 16.0  # factor for all when a step and its half are refused

    @property
    def fall(self) -> float:
        """Return what a damping falls to at most, as a part of itself."""
        return 1.0 / self.tets.shrink


OPTIONS = PerTetDamping()  # today's


@dataclass(frozen=True)
class Damping:
    """Levenberg-Marquardt damping, one of each active tet, ``tets`` (n_active,), and the ``jaw``'s.

    The flesh may need ten times more of one tet than of another: with dampings of their own no
    activation outruns the linear model, and none waits for others. They fall to no less than
    ``fall`` times themselves a step, and more slowly after every refused step.
    """

    tets: Floats
    jaw: float
    fall: float = OPTIONS.fall

    @classmethod
    def start(cls, count: int) -> Damping:
        """Return the damping of the first step."""
        return cls(np.full(count, OPTIONS.tets.start), OPTIONS.jaw.start)

    def limit(self, at: Floats, a: Floats, b: Floats) -> tuple[Floats, Floats, Damping]:
        """Cut a step (a, b) from activations ``at`` tet by tet; return it and the next damping."""
        length = (
            np.sqrt(np.einsum("ei,eij,ej->e", a, stretches.metric(at), a)) / OPTIONS.largest_step
        )
        jaw = float(np.abs(JAW_UNITS * b).max()) / OPTIONS.largest_jaw_step
        damping = Damping(
            OPTIONS.tets.scale(self.tets, length, self.fall),
            float(OPTIONS.jaw.scale(np.array(self.jaw), np.array(jaw), self.fall)),
            self.fall,
        )
        return a / np.maximum(length, 1.0)[:, None], b / max(jaw, 1.0), damping

    def scale(self, factor: float) -> Damping:
        """Return this damping times ``factor``."""
        return Damping(factor * self.tets, factor * self.jaw, self.fall)

    @property
    def is_hindered(self) -> bool:
        """Tell whether small gains may be the damping's doing."""
        return self.fall > OPTIONS.fall

    def afresh(self) -> Damping:
        """Return this damping without the memory of refused steps."""
        return Damping(self.tets, self.jaw)

    def after_refusal(self) -> Damping:
        """Return the damping to try again with."""
        more = self.scale(OPTIONS.refused)
        return Damping(more.tets, more.jaw, float(np.sqrt(self.fall)))
