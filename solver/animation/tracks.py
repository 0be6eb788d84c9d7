"""Values over time between keys."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from scipy.interpolate import PchipInterpolator

from solver.errors import InputError
from solver.surface import Floats

Interpolation = Literal["smooth", "linear"]
"""``smooth`` is a monotone cubic (Fritsch and Carlson 1980), which goes beyond no key's value."""

SHORTEST_SECONDS = 1e-9
"""Between two keys: values change at no infinite rate."""

Track = Callable[[float], Floats]


def track(
    times: Sequence[float], values: Floats, what: str, interpolation: Interpolation = "smooth"
) -> Track:
    """Return values (c,) at any time from ``values`` (k, c) at the keys' ``times`` (k,) in s.

    Before the first key and after the last they are as there, and zero if there is none. Raises
    :class:`InputError` (``scene.times``) if a key is not later than the one before, or its time is
    no number; ``what`` is the list of the keys, as the scene calls it.
    """
    check_times(times, what)
    if not len(times):
        return lambda _time: np.zeros(values.shape[1])
    if len(times) == 1:
        return lambda _time: values[0]
    first, last = times[0], times[-1]
    if interpolation == "smooth":
        curve = PchipInterpolator(times, values)
        return lambda time: np.asarray(curve(min(max(time, first), last)))
    return lambda time: np.array([np.interp(time, times, column) for column in values.T])


def check_times(times: Sequence[float], what: str) -> None:
    """Raise ``scene.times`` unless every time is a number and later than the one before."""
    for number, time in enumerate(times):
        if not np.isfinite(time):
            raise InputError("scene.times", f"the time of {what}[{number}] is {time}", key=number)
        if number and time - times[number - 1] < SHORTEST_SECONDS:
            raise InputError(
                "scene.times",
                f"{what}[{number}] at {time:g} s is not later than the one before",
                key=number,
            )
