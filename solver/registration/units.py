"""Units and axes of a raw scan: those a file may have, and those that a face's size speaks for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from solver.errors import InputError
from solver.surface import Floats

UNITS = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}  # name -> mm
AXES = {  # name -> direction in the file's frame
    "x": (1.0, 0.0, 0.0),
    "-x": (-1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "-y": (0.0, -1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
    "-z": (0.0, 0.0, -1.0),
}
# The options of every job that reads a raw scan, with their defaults.
FRAME = {"unit": "auto", "up": "auto", "forward": "auto"}


@dataclass(frozen=True)
class UnitOptions:
    """Sizes of scans and faces that are likely, for finding a scan's unit."""

    extent_mm: tuple[float, float] = (90.0, 1100.0)  # a bare face to two people's shoulders
    slips: tuple[float, ...] = (0.001, 0.1, 10.0, 1000.0)  # factors of a unit that is mixed up
    ladder_mm: tuple[float, ...] = (
        310.0,
        230.0,
        420.0,
        170.0,
        570.0,
    )  # of scans, likely ones first
    face_sizes: tuple[float, float] = (0.77, 1.3)  # of persons, by the template's face


UNIT_OPTIONS = UnitOptions()


def check_frame(frame: Mapping[str, Any]) -> None:
    """Raise :class:`InputError` (``options.unit``, ``options.axes``) for what does not exist."""
    unit = str(frame["unit"])
    if unit != "auto" and unit not in UNITS:
        raise InputError(
            "options.unit",
            f"unit is {unit!r}, not one of auto, {', '.join(UNITS)}",
            expected=["auto", *UNITS],
        )
    given = [str(frame[name]) for name in ("up", "forward")]
    for name, axis in zip(("up", "forward"), given, strict=True):
        if axis != "auto" and axis not in AXES:
            raise InputError(
                "options.axes",
                f"{name} is {axis!r}, not one of auto, {', '.join(AXES)}",
                expected=["auto", *AXES],
            )
    if "auto" not in given and given[0].lstrip("-") == given[1].lstrip("-"):
        raise InputError("options.axes", "up and forward must be two different axes")


def given_axis(frame: Mapping[str, Any], name: str) -> Floats | None:
    """Return the direction (3,) that ``frame`` gives for ``up`` or ``forward``; None for auto."""
    axis = str(frame[name])
    return None if axis == "auto" else np.array(AXES[axis])


def nearest_axis(direction: Floats) -> str:
    """Return the name of the axis that comes nearest to ``direction`` (3,)."""
    return max(AXES, key=lambda name: float(np.dot(AXES[name], direction)))


def candidate_scales(
    extent: float, unit: str, declared: float | None, options: UnitOptions = UNIT_OPTIONS
) -> list[list[float]]:
    """Return lists of mm per unit to try for a scan of this ``extent``, the likelier ones first.

    ``declared`` is the mm per unit of the file's format. Known units come first, then those that
    are wrong by a decimal slip, then sizes of heads whatever the unit.
    """
    first = UNITS.get(unit, declared)
    low, high = options.extent_mm
    known = [first] if first is not None else list(UNITS.values())
    slips = {(first or 1.0) * factor for factor in options.slips}
    odd = sorted((slips | set(UNITS.values())) - set(known))
    ladder = [size / max(extent, 1e-30) for size in options.ladder_mm]
    rounds = [
        [scale for scale in scales if low <= scale * extent <= high]
        for scales in (known, odd, ladder)
    ]
    return [scales for scales in rounds if scales]


def choose_unit(
    scale: float, unit: str, declared: float | None, options: UnitOptions = UNIT_OPTIONS
) -> tuple[float, str | None]:
    """Return mm per unit and the unit's name for a ``scale`` that takes a face to the template's.

    The given unit comes first, then the declared one, then the one that makes the likeliest size,
    then any decimal slip of one (without a name), then the template's size.
    """
    names = {factor: name for name, factor in UNITS.items()}
    first = UNITS.get(unit, declared)
    known = ([first] if first is not None else []) + list(UNITS.values())
    slips = [factor * (first or 1.0) for factor in options.slips]
    for factor in [*known, *slips]:
        if options.face_sizes[0] <= factor / scale <= options.face_sizes[1]:
            return factor, names.get(factor)
    return scale, None


def is_slip(ratio: float, options: UnitOptions = UNIT_OPTIONS) -> bool:
    """Return whether two units whose ratio this is are mixed up by a decimal slip."""
    return any(np.isclose(ratio, slip) for slip in options.slips)
