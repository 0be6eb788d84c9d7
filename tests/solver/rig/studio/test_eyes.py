"""The eyes' image and an eyeball's places in it."""

from __future__ import annotations

import io

import numpy as np
from PIL import Image

from solver.rig.studio.eyes import EyeImageOptions, eye_image, eye_places


def test_the_iris_lies_where_an_eyeball_looks() -> None:
    options = EyeImageOptions()
    turns = np.linspace(0.0, np.pi, 19)
    across = np.radians(np.arange(0.0, 360.0, 30.0))
    turn, way = (each.ravel() for each in np.meshgrid(turns, across))
    sides = np.stack([np.cos(way), np.sin(way)])
    points = 12.0 * np.column_stack([*(np.sin(turn) * sides), np.cos(turn)])
    places = eye_places(points + np.array([30.0, 40.0, 70.0]))
    assert places.min() >= 0.0
    assert places.max() <= 1.0
    image = np.asarray(Image.open(io.BytesIO(eye_image())), np.float64)
    columns = (places[:, 0] * (options.pixels - 1)).round().astype(int)
    rows = ((1.0 - places[:, 1]) * (options.pixels - 1)).round().astype(int)
    bright = image[rows, columns].mean(axis=1)
    assert bright[turn < np.radians(10.0)].max() < 60.0  # the pupil
    assert np.all((bright > 60.0) & (bright < 160.0), where=turn == turns[2])  # 20 degrees
    assert bright[turn > np.radians(35.0)].min() > 200.0  # the sclera, and the back
    # as it is seen: up is up, the subject's left at the image's right
    left = eye_places(points)[(turn == turns[1]) & (way == 0.0)]
    assert left[0, 0] > 0.5
