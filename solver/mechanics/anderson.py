"""Anderson's acceleration of corrections with an old stiffness.

Walker and Ni (2011), Anderson acceleration for fixed-point iterations: the corrections so far tell
in which few modes the stiffness is wrong.
"""

from __future__ import annotations

import numpy as np

from solver.surface import Floats

KEPT = 8
"""Corrections that it looks back on."""


class Accelerator:
    """Takes points (size,) with the corrections (size,) there, and makes better corrections."""

    def __init__(self) -> None:
        self._points: list[Floats] = []
        self._corrections: list[Floats] = []

    def step(self, point: Floats, correction: Floats) -> Floats:
        """Return the step from ``point``, the ``correction`` there itself if it is the first."""
        self._points = [*self._points[-KEPT:], point]
        self._corrections = [*self._corrections[-KEPT:], correction]
        if len(self._points) < 2:
            return correction
        changes = np.diff(self._corrections, axis=0).T
        # they get shorter by orders of magnitude: all count alike
        scale = np.linalg.norm(changes, axis=0)
        if not (np.isfinite(scale).all() and scale.all()):
            return correction
        weights = np.linalg.lstsq(changes / scale, correction, rcond=1e-6)[0] / scale
        return np.asarray(correction - (np.diff(self._points, axis=0).T + changes) @ weights)
