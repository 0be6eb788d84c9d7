"""The face seen from the front as a map of heights: what is foremost at each place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from solver.drawing.raster import Camera, look
from solver.surface import Floats, Surface

FAR_MM = 4000.0  # so far away that the view is nearly parallel


@dataclass(frozen=True)
class Relief:
    """Heights z (rows, columns) in mm, NaN where there is nothing; rows go down from the top.

    ``x`` (columns,) and ``y`` (rows,) are the places in mm.
    """

    height: Floats
    x: Floats
    y: Floats


def relief(surface: Surface, centre: Floats, size: tuple[float, float], step: float) -> Relief:
    """Return the relief of a mesh or, without faces, of points.

    ``centre`` (3,) and ``size`` (width, height) in mm say which part, ``step`` how fine.
    """
    columns, rows = (max(round(length / step), 1) for length in size)
    x = centre[0] + (np.arange(columns) + 0.5 - columns / 2) * step
    y = centre[1] + (rows / 2 - np.arange(rows) - 0.5) * step
    height = np.full((rows, columns), np.nan)
    if len(surface.faces):
        camera = Camera(centre, rows * step, distance=FAR_MM)
        seen = look(camera, surface, columns, rows)
        if seen.mask.any():
            height[seen.mask] = seen.interpolate(surface.vertices[:, 2:])[:, 0]
        return Relief(height, x, y)
    column = np.floor((surface.vertices[:, 0] - x[0]) / step + 0.5).astype(np.int64)
    row = np.floor((y[0] - surface.vertices[:, 1]) / step + 0.5).astype(np.int64)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    np.fmax.at(height, (row[inside], column[inside]), surface.vertices[inside, 2])
    return Relief(height, x, y)
