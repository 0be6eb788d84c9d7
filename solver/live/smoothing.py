"""Smooth what goes out: a low pass whose cutoff rises with speed.

    y += alpha (x - y),    alpha = 1 / (1 + 1 / (2 pi f dt)),    f = f_0 + beta |dx/dt|

The one-euro filter (Casiez, Roussel and Vogel 2012): still faces do not tremble, and fast ones are
not late. alpha is a half at least, so that what moves evenly is late by one frame at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.surface import Floats


@dataclass(frozen=True)
class OneEuro:
    """Numbers of the filter; speeds are in the numbers' ``scale`` a second."""

    cutoff_hz: float  # f_0
    beta: float = 4.0  # Hz for each unit of speed
    speed_hz: float = 6.0  # cutoff of the speed itself
    least: float = 0.5  # alpha: the delay is (1 - alpha) / alpha frames


@dataclass(frozen=True)
class SmoothScales:
    """Units in which speeds of a face's numbers are counted: about what a lively face moves by."""

    value: float = 1.0  # of a slider
    amount: float = 4.0  # of a mode of the skin, mm
    turn_rad: float = 0.5  # of the head
    shift_mm: float = 40.0


class Smoother:
    """Filters rows of numbers (k,) of the sizes ``scale`` (k,)."""

    def __init__(self, options: OneEuro, scale: Floats) -> None:
        self._options = options
        self._scale = scale
        self.begin()

    def begin(self) -> None:
        """Forget what was before."""
        self._last: tuple[Floats, Floats, Floats] | None = None

    def __call__(self, row: Floats, seconds: float) -> Floats:
        """Return a row (k,) filtered, which comes so long after the last."""
        if self._last is None:
            self._last = row, np.zeros_like(row), row
            return row
        before, speed, smooth = self._last
        options = self._options
        now = (row - before) / (seconds * self._scale)
        speed = speed + _part(options.speed_hz, seconds) * (now - speed)
        cutoff = options.cutoff_hz + options.beta * np.abs(speed)
        kept = np.maximum(_part(cutoff, seconds), options.least)
        smooth = smooth + kept * (row - smooth)
        self._last = row, speed, smooth
        return smooth


def _part(cutoff_hz: Floats | float, seconds: float) -> Floats:
    return np.asarray(1.0 / (1.0 + 1.0 / (2.0 * np.pi * np.asarray(cutoff_hz) * seconds)))
