"""Wrinkles of an expression: how its normal map differs from the neutral's, and where.

Slopes of both are by the same coordinates on the same mesh, so that their difference is that of the
skin: a rig adds it, times the weight of the expression, to the slopes of the neutral's map.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from solver.registration.detail import Detail
from solver.registration.detail_fields import SmoothFields
from solver.registration.normal_maps import by_slopes, slopes
from solver.registration.skin_images import made_for
from solver.registration.texels import to_bytes
from solver.registration.topology import Topology
from solver.surface import Floats


@dataclass(frozen=True)
class WrinkleOptions:
    """Where skin counts as wrinkled, by the mean change of slopes around."""

    width: float = 12.0  # mm; waves of this length are halved in the mask
    changes: tuple[float, float] = (0.03, 0.08)  # from which on the mask begins, and is full


WRINKLES = WrinkleOptions()


@dataclass(frozen=True, eq=False)
class Wrinkles:
    """What an expression changes in a normal map, at the texels (t) of its detail."""

    detail: Detail  # of the expression
    slopes: Floats  # (t, 2) less the neutral's
    mask: Floats  # (t,) from 0, nothing changes, to 1
    figures: dict[str, Any]  # of registration.json

    def write(self, path: Path) -> None:
        """Write the change as a normal map with the mask for its opacity, as PNG."""
        normals = 0.5 * (by_slopes(self.slopes) + 1.0)
        image = self.detail.texels.spread(to_bytes(np.column_stack([normals, self.mask])))
        Image.fromarray(image).save(path, pnginfo=made_for(self.detail.coordinates))


def wrinkles(
    detail: Detail, neutral: Floats, topology: Topology, options: WrinkleOptions = WRINKLES
) -> Wrinkles:
    """Return how an expression's ``detail`` differs from the ``neutral``'s normals (t, 3).

    Where nothing is known of the expression nothing changes.
    """
    known = detail.known
    change = known[:, None] * (slopes(detail.normals) - slopes(neutral))
    own = np.flatnonzero(known > 0.0)
    mask = np.zeros(len(known))
    smooth = SmoothFields(detail.texels.chosen(own), known[own], options.width / (2.0 * np.pi))
    squared = smooth((change[own] ** 2).sum(axis=1, keepdims=True))[:, 0]
    least, most = options.changes
    change_around = np.sqrt(np.maximum(squared, 0.0))
    mask[own] = known[own] * np.clip((change_around - least) / (most - least), 0.0, 1.0)
    return Wrinkles(detail, change, mask, _figures(detail, mask, topology))


def _figures(detail: Detail, mask: Floats, topology: Topology) -> dict[str, Any]:
    """Return the share of each region's area that the mask has."""
    texels = detail.texels
    found = {}
    for name, vertices in topology.template.regions.items():
        own = texels.within(np.intersect1d(vertices, topology.outer))
        if len(own):
            found[name] = round(float(np.average(mask[own], weights=texels.areas(own))), 4)
    return {"regions": found}
