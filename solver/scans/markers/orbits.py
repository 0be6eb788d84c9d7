"""Rims of a person's orbits, on which another actor's markers of that name are put.

Another actor's face lies on the person's by one size for all of it, which may leave markers of the
orbit on the lids, where they would blink.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from solver.scans.markers.names import PLACES, Named
from solver.surface import Floats, Ints

REGIONS = ("orbit", "eye")  # what is on a lid is called so
MIDDLE = PLACES["eye"][""][0], PLACES["eye"]["inner"][1]  # of the left eye by names
PAST_LIDS_MM = 4.0  # of the rim


@dataclass(frozen=True)
class Rim:
    """The rim of an orbit as it is seen from the front: quarters of ellipses about the eye."""

    middle: Floats  # (2,) of the eyeball, mm
    low: Floats  # (2,) how far the rim is from it to the person's right, and down
    high: Floats  # (2,) and to the left, and up

    def clear(self, point: Floats, named: Named) -> Floats:
        """Return a point (3,) of the skin moved out to the rim, up or aside as its name says."""
        off = point[:2] - self.middle
        across, up = abs(named.place[0]) - MIDDLE[0], named.place[1] - MIDDLE[1]
        axis = int(abs(up) >= abs(across))
        sign = np.sign(up) if axis else np.sign(across) * named.side
        half = np.where(off < 0, self.low, self.high)
        other = min(abs(off[1 - axis] / half[1 - axis]), 1.0)
        least = float((self.high if sign > 0 else self.low)[axis] * np.sqrt(1.0 - other**2))
        moved = point.copy()
        moved[axis] = self.middle[axis] + sign * max(sign * off[axis], least)
        return moved


def find_rims(skin: Floats, regions: Mapping[str, Ints]) -> dict[int, Rim]:
    """Return the rims of a face's ``skin`` (V, 3) by side, 1 the left; none without its lids."""
    rims = {}
    for side, eye in ((1, "left"), (-1, "right")):
        names = [f"{eye}_eyeball", f"{eye}_upper_lid", f"{eye}_lower_lid"]
        if not all(len(regions.get(name, ())) for name in names):
            continue
        ball, *lids = (skin[regions[name]][:, :2] for name in names)
        middle, both = ball.mean(axis=0), np.concatenate(lids)
        low, high = middle - both.min(axis=0), both.max(axis=0) - middle
        rims[side] = Rim(middle, low + PAST_LIDS_MM, high + PAST_LIDS_MM)
    return rims


def clear_lids(placed: Floats, names: tuple[Named | None, ...], rims: Mapping[int, Rim]) -> Floats:
    """Return markers (n, 3) with those that are named after the orbit no nearer than its rim."""
    found = placed.copy()
    for number, named in enumerate(names):
        if named is not None and named.region in REGIONS and named.side in rims:
            found[number] = rims[named.side].clear(placed[number], named)
    return found
