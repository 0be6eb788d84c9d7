"""Levenberg-Marquardt damping for thousands of activations, each trusted by itself."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.fitting import stretches
from solver.fitting.controls import JAW_UNITS
from solver.surface import Floats

LARGEST_STEP = 0.5
LARGEST_JAW_STEP = 2.0
"""How far the linear model is trusted: a tet's change |dS(a_i)|, relative, and the jaw's in mm."""

DAMPING_START = 1.0
JAW_DAMPING_START = 1e-2
DAMPING_LEAST = 1e-7
DAMPING_FALL = 0.25
DAMPING_GROWTH = 8.0
"""By what a damping falls and grows at most from step to step."""

DAMPING_REFUSED = 16.0
"""By what all dampings grow when a step and its half are refused."""


@dataclass(frozen=True)
class Damping:
    """Levenberg-Marquardt damping, one of each active tet, ``tets`` (n_active,), and the ``jaw``'s.

    The flesh may need ten times more of one tet than of another: with dampings of their own no
    activation outruns the linear model, and none waits for others. They fall to no less than
    ``fall`` times themselves a step, and more slowly after every refused step.
    """

    tets: Floats
    jaw: float
    fall: float = DAMPING_FALL

    @classmethod
    def start(cls, count: int) -> Damping:
        """Return the damping of the first step."""
        return cls(np.full(count, DAMPING_START), JAW_DAMPING_START)

    def limited(self, at: Floats, a: Floats, b: Floats) -> tuple[Floats, Floats, Damping]:
        """Cut a step (a, b) from activations ``at`` tet by tet; return it and the next damping."""
        length = np.sqrt(np.einsum("ei,eij,ej->e", a, stretches.metric(at), a)) / LARGEST_STEP
        jaw = float(np.abs(JAW_UNITS * b).max()) / LARGEST_JAW_STEP
        tets = self.tets * np.clip(length, self.fall, DAMPING_GROWTH)
        damping = Damping(
            np.maximum(tets, DAMPING_LEAST),
            max(self.jaw * min(max(jaw, self.fall), DAMPING_GROWTH), DAMPING_LEAST),
            self.fall,
        )
        return a / np.maximum(length, 1.0)[:, None], b / max(jaw, 1.0), damping

    def raised(self, factor: float) -> Damping:
        """Return this damping times ``factor``."""
        return Damping(factor * self.tets, factor * self.jaw, self.fall)

    @property
    def hindered(self) -> bool:
        """Tell whether small gains may be the damping's doing."""
        return self.fall > DAMPING_FALL

    def afresh(self) -> Damping:
        """Return this damping without the memory of refused steps."""
        return Damping(self.tets, self.jaw)

    def after_refusal(self) -> Damping:
        """Return the damping to try again with."""
        raised = self.raised(DAMPING_REFUSED)
        return Damping(raised.tets, raised.jaw, float(np.sqrt(self.fall)))
