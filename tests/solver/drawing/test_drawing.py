"""The rasteriser and exact geometry, light and shadow, colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.drawing.head import both_sides, heat, muscle_colours
from solver.drawing.render import Camera, DrawnBody, Lit, irradiance, look, render
from solver.surface import Surface


def square(z: float, half: float) -> Surface:
    corners = np.array([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))


def test_a_camera_sees_the_nearer_triangle_at_its_true_place() -> None:
    near = square(10.0, 20.0)
    far = square(-30.0, 80.0)
    both = Surface(np.vstack([far.vertices, near.vertices]), np.vstack([far.faces, near.faces + 4]))
    camera = Camera(np.zeros(3), span=100.0, yaw=0.4, pitch=0.2, distance=500.0)
    seen = look(camera, both, 200, 200)
    rows, columns = np.nonzero(seen.mask)
    points = seen.interpolate(both.vertices)
    places = camera.project(points.astype(np.float64), 200, 200)
    np.testing.assert_allclose(places[:, 0], columns + 0.5, atol=2e-2)
    np.testing.assert_allclose(places[:, 1], rows + 0.5, atol=2e-2)
    centre = camera.project(np.array([[0.0, 0.0, 10.0]]), 200, 200)[0].astype(int)
    assert seen.triangle[centre[1], centre[0]] >= 2
    assert set(np.round(points[:, 2])) == {10.0, -30.0}


def test_what_is_not_covered_fades_out() -> None:
    plate = square(0.0, 40.0)
    lit = Lit(plate)
    camera = Camera(np.zeros(3), span=100.0)
    cover = np.array([0.0, 0.0, 1.0, 1.0])  # whole above, nothing at its lower edge
    black = np.zeros((4, 3))
    body = DrawnBody(lit, black, gloss=0.0)
    faded, whole = (render([each], camera, 80, 80) for each in (replace(body, cover=cover), body))
    rows = [12, 40, 68]
    assert (whole[rows, 40] == 0.0).all()
    above, middle, below = faded[rows, 40, 0]
    assert above < 0.4 < middle < 0.8 < below


def test_front_view_shows_the_subjects_left_on_the_right() -> None:
    places = Camera(np.zeros(3), span=100.0).project(np.array([[20.0, 30.0, 0.0]]), 100, 100)[0]
    np.testing.assert_allclose(places, [70.0, 20.0, 1100.0])
    from_left = Camera(np.zeros(3), span=100.0, yaw=np.pi / 2)
    assert from_left.project(np.array([[20.0, 0.0, 0.0]]), 100, 100)[0, 2] == pytest.approx(1080.0)


def test_a_plate_in_front_takes_light_away() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-90, 90, 31), np.linspace(-90, 90, 31)), -1)
    points = np.column_stack([grid.reshape(-1, 2), np.zeros(31 * 31)])
    number = np.arange(31 * 31).reshape(31, 31)
    a = number[:-1, :-1].ravel()
    b = number[:-1, 1:].ravel()
    c = number[1:, 1:].ravel()
    d = number[1:, :-1].ravel()
    wall = Surface(points, np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))
    plate = square(15.0, 30.0)
    both = Surface(np.vstack([points, plate.vertices]), np.vstack([wall.faces, plate.faces + 961]))
    forward = np.tile([0.0, 0.0, 1.0], (len(both.vertices), 1))
    light = irradiance(both, forward)[:961].mean(axis=1)
    middle = light[number[15, 15]]
    corner = light[number[28, 2]]
    assert middle < 0.35 * corner
    assert irradiance(wall, forward[:961])[number[15, 15]].mean() > 0.9 * corner


def test_colours() -> None:
    assert (
        both_sides("orbital part of left orbicularis oculi") == "orbital part of orbicularis oculi"
    )
    assert both_sides("zygomaticus_major_L") == "zygomaticus major"
    colours = muscle_colours(("left a", "right a", "left b", "c"))
    assert list(colours) == ["a", "b", "c"]
    np.testing.assert_allclose(
        heat(np.array([0.0, 99.0])), [heat(np.array([0.0]))[0], (0.55, 0.05, 0.18)]
    )
