"""Whether the mouth is open in a face taken for rest, by the places of the lips' markers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from solver.scans.markers.locate import LocateOptions, fit_most
from solver.scans.markers.names import LOWER, Named
from solver.surface import Floats


def lips_apart(
    placed: Floats, names: Sequence[Named | None], goal: Floats, least: int = LocateOptions.least
) -> float:
    """Return how much farther apart the lips are in ``placed`` (k, 3) than in ``goal`` (k, 3), mm.

    ``goal`` has the lips closed, y up; the size of the face is that of its markers above the lower
    lip. NaN if markers of both lips, or ``least`` others, are not known in both.
    """
    known = np.isfinite(placed[:, 0]) & np.isfinite(goal[:, 0])
    known &= np.array([each is not None and each.part == "face" for each in names], bool)
    regions = [None if each is None else each.region for each in names]
    is_upper = known & np.array([each == "upper_lip" for each in regions], bool)
    is_lower = known & np.array([each == "lower_lip" for each in regions], bool)
    still = known & np.array([each not in LOWER for each in regions], bool)
    if still.sum() < least or not is_upper.any() or not is_lower.any():
        return float("nan")
    motion, _ = fit_most(placed[still], goal[still])
    off = motion(placed)[:, 1] - goal[:, 1]
    return float(off[is_upper].mean() - off[is_lower].mean())


def named_places(names: Sequence[Named | None]) -> Floats:
    """Return the places (k, 3) on a middling face by names, NaN for those without one."""
    nowhere = (np.nan, np.nan, np.nan)
    return np.array([nowhere if each is None else each.place for each in names], float)
