"""Reading landmarks over time from NPZ, as any tracker of video can write them.

``names`` (k,) and ``points`` (f, k, 3), NaN where one is not seen; ``sigma``, standard deviations a
coordinate, of any shape that spreads to that of the points, as video sees depth far worse; and
``rate`` (Hz), ``first`` (a frame's number) and ``unit`` (a name, or mm) if they are known.
"""

from __future__ import annotations

import numpy as np

from solver.errors import quote
from solver.scans.markers.readers.raw_take import (
    MOST_FRAME,
    RawTake,
    TakeOptions,
    check_room,
    choose_rate,
    unreadable_error,
)
from solver.storage import Arrays
from solver.surface import Floats


def arrange_landmarks(file: str, arrays: Arrays, options: TakeOptions) -> RawTake:
    """Return landmarks as a take.

    Raises :class:`InputError`: ``markers.unreadable``, ``markers.none`` or ``markers.too_large``.
    """
    missing = [name for name in ("names", "points") if name not in arrays]
    if missing:
        raise unreadable_error(file, f"it has no array '{missing[0]}'")
    names, points = arrays["names"], arrays["points"]
    is_right = names.dtype.kind == "U" and names.ndim == 1 and points.dtype.kind in "fiu"
    if not is_right or points.ndim != 3 or points.shape[1:] != (len(names), 3):
        shapes = f"names {quote(names.shape)} and points {quote(points.shape)}"
        raise unreadable_error(
            file, f"it has {shapes}; names (k,) and points (f, k, 3) are expected"
        )
    check_room(file, len(points), len(names), options)
    points = points.astype(float)
    points[~points.any(axis=-1)] = np.nan  # exactly 0, 0, 0
    labels = names.tolist()
    sigma = _sigma(file, arrays["sigma"], points, labels, options) if "sigma" in arrays else None
    number = _number(file, arrays, "rate")
    rate, findings = choose_rate(file, [] if number is None else [("rate", number)], options)
    first = _number(file, arrays, "first")
    if first is not None and not abs(first) <= MOST_FRAME:
        raise unreadable_error(file, f"'first' is {first:g}, not the number of a frame")
    unit = _unit(file, arrays, options)
    number = 1 if first is None else int(first)
    return RawTake(labels, points, rate, number, unit, sigma=sigma, findings=findings)


def _sigma(
    file: str, given: np.ndarray, points: Floats, labels: list[str], options: TakeOptions
) -> Floats:
    """Return sigma (f, k, 3); a point of which it is not finite becomes missing."""
    by_point = given[..., None] if given.shape in (points.shape[:2], points.shape[1:2]) else given
    try:
        spread = np.broadcast_to(by_point, points.shape)
    except ValueError:
        reason = f"sigma {quote(given.shape)} does not spread to points {quote(points.shape)}"
        raise unreadable_error(file, reason) from None
    if spread.dtype.kind not in "fiu":
        raise unreadable_error(file, f"sigma holds {quote(spread.dtype)}, not numbers")
    sigma = spread.astype(float)
    points[~np.isfinite(sigma).all(axis=-1)] = np.nan
    is_bad = (~(sigma >= options.least_sigma)).any(axis=-1) & np.isfinite(points).all(axis=-1)
    if is_bad.any():
        frame, track = map(int, np.argwhere(is_bad)[0])
        label = quote(labels[track])
        reason = f"sigma of {label} in frame {frame} is not above {options.least_sigma:g}"
        raise unreadable_error(file, reason, label=label, frame=frame)
    return sigma


def _number(file: str, arrays: Arrays, name: str) -> float | None:
    value = arrays.get(name)
    if value is None:
        return None
    if value.size != 1 or value.dtype.kind not in "fiu":
        raise unreadable_error(file, f"'{name}' is not a number")
    return float(value.reshape(-1)[0])


def _unit(file: str, arrays: Arrays, options: TakeOptions) -> str | float | None:
    value = arrays.get("unit")
    if value is None or value.dtype.kind != "U":
        mm = _number(file, arrays, "unit")
        least, most = options.units_mm
        if mm is not None and not least <= mm <= most:
            raise unreadable_error(file, f"'unit' is {mm:g}, not {least:g} to {most:g} mm")
        return mm
    return str(value.reshape(-1)[0]) if value.size == 1 else None
