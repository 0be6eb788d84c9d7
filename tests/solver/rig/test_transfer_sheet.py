"""The sheet of a transfer: which frames it shows, and faces that are painted for it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from solver.rig.painted_faces import BROWS, PAINT, PaintedFaces
from solver.rig.transfer_sheet import most_different
from solver.templates.builtin.build import builtin_template
from tests.fixtures import small_model


def test_the_frames_that_differ_most_are_shown_in_order() -> None:
    weights = np.zeros((50, 3))
    weights[10, 0] = weights[30, 1] = weights[20, 2] = 1.0
    weights[20:25] += 0.01
    assert most_different(weights, np.arange(50), 4).tolist() == [0, 10, 20, 30]
    assert most_different(weights, np.array([5, 10]), 4).tolist() == [5, 10]


def test_brows_are_painted_where_they_are() -> None:
    model = small_model()
    points = builtin_template().points
    assert points is not None
    painted = PaintedFaces(model, points, replace(PAINT, size=(256, 256)))
    picture = painted.picture(model.skin.vertices).mean(axis=2)

    def dark(numbers: tuple[int, ...]) -> float:
        """Return the least light about landmarks."""
        known = points.select([str(number) for number in numbers if points.has(str(number))])
        places = painted.camera.project(known.at(model.skin.vertices), 256, 256)[:, :2]
        column, row = places.mean(axis=0).round().astype(int)
        return float(picture[row - 2 : row + 3, column - 2 : column + 3].min())

    forehead = dark((9, 8, 151, 108, 337))
    assert all(dark(brow) < 0.6 * forehead for brow in BROWS.values())
