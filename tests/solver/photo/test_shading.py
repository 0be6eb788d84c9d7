"""Shading: derivatives by differences, and light and albedo found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.anatomy.skin_points import SkinSamples
from solver.drawing.render import rasterise
from solver.photo.camera import PinholeCamera
from solver.photo.expression import ShadingOptions, shading_of
from solver.photo.light import Appearance
from solver.photo.photo import Photo
from solver.photo.shading import (
    BANDS,
    HARMONICS,
    ShadingTerm,
    SmoothImage,
    harmonic_rates,
    harmonics,
    shade_of,
    sum_rates,
    vertex_sums,
)
from solver.surface import Surface, unit_rows, vertex_normals
from tests.solver.ball import ball
from tests.solver.photo.derivatives import check_derivatives

TURN = Rotation.from_euler("xy", [0.2, 0.1]).as_matrix()
CAMERA = PinholeCamera(np.full(2, 500.0), np.full(2, 60.0), TURN, np.array([0.0, 0.0, 300.0]))


@pytest.fixture(scope="module")
def term() -> tuple[ShadingTerm, np.ndarray, PinholeCamera]:
    """Return a ball's shading in a picture of waves, its vertices, and a camera."""
    random = np.random.default_rng(0)
    surface = ball(np.zeros(3), 20.0, 2)
    row, column = np.mgrid[:120, :120]
    waves = [0.5 + 0.3 * np.sin(row / 9.0 + k) * np.cos(column / 7.0) for k in range(3)]
    seen = surface.faces[random.choice(len(surface.faces), 40)]
    samples = SkinSamples(seen, random.dirichlet(np.ones(3), 40))
    light = random.normal(0.0, 0.3, (HARMONICS, 3))
    image = SmoothImage.blurred(np.stack(waves, axis=2), 1.0)
    albedo = random.uniform(0.3, 0.8, (40, 3))
    blocked = random.normal(0.0, 0.1, (40, HARMONICS))
    found = ShadingTerm(image, surface.faces, samples, albedo, blocked, light, 0.05)
    return found, surface.vertices, CAMERA


def test_derivatives_are_those_of_differences(term) -> None:
    check_derivatives(*term, step=1e-5, tolerance=1e-5)


def drawn(stubble: float) -> Photo:
    """Return a ball of even skin in a soft light, with ``stubble`` of so much on its lower half."""
    surface = ball(np.zeros(3), 20.0, 3)
    light = np.zeros(HARMONICS)
    light[:3] = 0.12, 0.03, 0.02
    shade = (BANDS * harmonics(vertex_normals(surface))) @ light
    seen = rasterise(CAMERA.project(surface.vertices), surface.faces, 120, 120)
    pixels = np.zeros((120, 120, 3))
    pixels[seen.mask] = seen.interpolate(shade[:, None] * [0.9, 0.7, 0.6])
    random = np.random.default_rng(4)
    pixels[60:] *= 1.0 + stubble * random.uniform(-1.0, 1.0, (60, 120, 1))
    return Photo("ball", (pixels ** (1 / 2.2)).astype(np.float32))


def test_what_light_and_albedo_leave_is_a_picture_s_noise() -> None:
    surface = ball(np.zeros(3), 20.0, 3)
    every = np.arange(len(surface.vertices))
    open_ = np.zeros((len(every), HARMONICS))
    given = ShadingOptions(detail_mm=0.1)

    def noise(stubble: float) -> float:
        term, _ = shading_of(drawn(stubble), CAMERA, surface, every, open_, given)
        assert isinstance(term, ShadingTerm)
        repeated = np.sqrt(len(term.samples.corners) / given.independent)
        colours = term.image.at(CAMERA.project(term.samples.of(surface.vertices))[:, :2])
        return float(term.noise / repeated / colours.mean())

    assert noise(0.0) == pytest.approx(given.least_noise)
    assert given.least_noise < noise(0.5) < noise(0.9) < 0.5


def test_a_face_in_the_corner_of_a_large_picture_is_compared_as_in_its_own() -> None:
    surface = ball(np.zeros(3), 20.0, 3)
    every = np.arange(len(surface.vertices))
    open_ = np.zeros((len(every), HARMONICS))
    alone = drawn(0.5)
    pixels = np.zeros((500, 800, 3), np.float32)
    pixels[300:420, 600:720] = alone.pixels
    large = replace(CAMERA, centre=CAMERA.centre + np.array([600.0, 300.0]))
    given = ShadingOptions(detail_mm=0.1)
    small_term, small_look = shading_of(alone, CAMERA, surface, every, open_, given)
    term, look = shading_of(Photo("large", pixels), large, surface, every, open_, given)
    assert isinstance(term, ShadingTerm)
    assert isinstance(small_term, ShadingTerm)
    assert max(term.image.pixels.shape[:2]) <= 120
    np.testing.assert_allclose(look.light, small_look.light, atol=0.01)
    assert term.noise == pytest.approx(small_term.noise, rel=0.02)
    moved = surface.vertices + np.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(
        np.linalg.norm(term.residual(moved, large)),
        np.linalg.norm(small_term.residual(moved, CAMERA)),
        rtol=0.03,
    )


def test_harmonics_have_their_rates() -> None:
    normals = np.random.default_rng(2).normal(size=(10, 3))
    for axis in range(3):
        way = 1e-6 * np.eye(3)[axis]
        expected = (harmonics(normals + way) - harmonics(normals - way)) / 2e-6
        np.testing.assert_allclose(harmonic_rates(normals)[..., axis], expected, atol=1e-7)


def test_a_light_is_the_same_in_other_axes() -> None:
    random = np.random.default_rng(5)
    light = random.normal(size=(HARMONICS, 3))
    normals = unit_rows(random.normal(size=(20, 3)))
    turned = Appearance(light, np.ones((4, 3))).turned(TURN)
    none = np.zeros((20, HARMONICS))
    np.testing.assert_allclose(
        shade_of(normals @ TURN.T, none, turned.light), shade_of(normals, none, light), atol=1e-9
    )
    np.testing.assert_allclose(turned.turned(TURN.T).light, light, atol=1e-9)


def test_sums_of_normals_have_their_rates() -> None:
    surface = ball(np.zeros(3), 20.0, 2)
    random = np.random.default_rng(3)
    way = random.normal(size=surface.vertices.shape)
    ahead, behind = (Surface(surface.vertices + s * 1e-5 * way, surface.faces) for s in (1, -1))
    expected = (vertex_sums(ahead) - vertex_sums(behind)) / 2e-5
    np.testing.assert_allclose(sum_rates(surface) @ way.ravel(), expected.ravel(), atol=1e-5)
