"""The skin's colours in a photograph: albedo by light, and what they say about its shape.

    colour_i = albedo_i * sum_b gamma_b (A_b Y_b(n_i) - s_ib),    noise r_i = colour_i - I(p(x_i))

Points x_i of the skin keep their albedo, n_i is the skin's normal there, Y are the nine spherical
harmonics up to the second degree, which hold all but a percent of what a Lambertian surface shows
of any light (Ramamoorthi and Hanrahan 2001), gamma (9, 3) is the light by channel, s what the face
blocks of it (held while the face moves), p the camera and I the picture, a cubic spline, all in
linear RGB. Published renderers compare pixel by pixel and have to differentiate what is seen in
each; points that stay on the skin give the same sum, exact derivatives, and as many residuals after
a step as before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import gaussian_filter

from solver.anatomy.skin_points import SkinSamples
from solver.drawing.render import SHADOWS, Shadows, gather, sphere
from solver.photo.camera import PinholeCamera
from solver.photo.terms import ImageTerm, LinearResidual, by_vertices
from solver.surface import Floats, Ints, Surface, area_normals, skew, unit_rows, vertex_normals

HARMONICS = 9  # of degrees 0 to 2
CHANNELS = 3  # red, green, blue


# of what a Lambertian surface gathers of light of each degree (Ramamoorthi and Hanrahan 2001)
BANDS = np.pi * np.array([1.0, *3 * [2 / 3], *5 * [1 / 4]])


def harmonics(directions: Floats) -> Floats:
    """Return Y (n, 9) of unit ``directions`` (n, 3), without the constants that light takes up."""
    x, y, z = directions.T
    one = np.ones_like(x)
    return np.column_stack([one, x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y])


def harmonic_rates(directions: Floats) -> Floats:
    """Return their derivatives (n, 9, 3)."""
    x, y, z = directions.T
    rates = np.zeros((len(directions), HARMONICS, 3))
    rates[:, 1, 0] = rates[:, 2, 1] = rates[:, 3, 2] = 1.0
    rates[:, 4, 0] = y
    rates[:, 4, 1] = x
    rates[:, 5, 1] = z
    rates[:, 5, 2] = y
    rates[:, 6, 2] = 6 * z
    rates[:, 7, 0] = z
    rates[:, 7, 2] = x
    rates[:, 8, 0] = 2 * x
    rates[:, 8, 1] = -2 * y
    return rates


def blocked_light(skin: Surface, shadows: Shadows = SHADOWS) -> Floats:
    """Return what each vertex (V, 9) loses of the light in every harmonic, to the skin around it.

    Hollows are dark, and a nose shades its cheek.
    """
    directions = sphere(shadows.directions)
    values = 4.0 * np.pi / shadows.directions * harmonics(directions)
    normals = vertex_normals(skin)
    open_ = np.maximum(normals @ directions.T, 0.0) @ values
    return open_ - gather(skin, normals, directions, values, shadows)


@dataclass(frozen=True)
class SmoothImage:
    """A picture (h, w, 3) as a function of places in it, with derivatives: a cubic spline.

    ``corner`` is the column and the row at which it begins, as a part of a larger picture.
    """

    pixels: Floats
    corner: tuple[int, int] = (0, 0)

    @classmethod
    def blurred(
        cls, pixels: Floats, sigma_px: float, corner: tuple[int, int] = (0, 0)
    ) -> SmoothImage:
        """Return a picture without detail finer than ``sigma_px``: a level of its pyramid."""
        sigma = (sigma_px, sigma_px, 0)
        return cls(gaussian_filter(np.asarray(pixels, np.float64), sigma), corner)

    @cached_property
    def _splines(self) -> Sequence[RectBivariateSpline]:
        height, width = self.pixels.shape[:2]
        left, top = self.corner
        rows = top + np.arange(height) + 0.5
        columns = left + np.arange(width) + 0.5
        return [RectBivariateSpline(rows, columns, self.pixels[..., c]) for c in range(CHANNELS)]

    def at(self, places: Floats) -> Floats:
        """Return the colours (n, 3) at places (n, 2), column and row."""
        column, row = places.T
        return np.column_stack([spline.ev(row, column) for spline in self._splines])

    def rates(self, places: Floats) -> Floats:
        """Return their derivatives (n, 3, 2) by column and row."""
        column, row = places.T
        found = [
            np.column_stack([spline.ev(row, column, dy=1), spline.ev(row, column, dx=1)])
            for spline in self._splines
        ]
        return np.stack(found, axis=1)


def normals_at(samples: SkinSamples, skin: Surface) -> Floats:
    """Return the skin's unit normals (n, 3) at points."""
    return unit_rows(samples.of(vertex_sums(skin)))


def facing(samples: SkinSamples, skin: Surface, camera: PinholeCamera) -> Floats:
    """Return the cosines (n,) between the skin's normals at points and the ways to the camera."""
    towards = -unit_rows(samples.of(skin.vertices) @ camera.rotation.T + camera.translation)
    return np.asarray((towards * (normals_at(samples, skin) @ camera.rotation.T)).sum(axis=1))


def vertex_sums(skin: Surface) -> Floats:
    """Return the sums (V, 3) of area normals of each vertex's triangles: normals, not unit ones."""
    by_face = area_normals(skin.vertices, skin.faces)
    sums = np.zeros_like(skin.vertices)
    for corner in range(3):
        np.add.at(sums, skin.faces[:, corner], by_face)
    return sums


def sum_rates(skin: Surface) -> sp.csr_array:
    """Return the derivative (3 V, 3 V) of :func:`vertex_sums` by the vertices."""
    faces = skin.faces
    size = 3 * len(skin.vertices)
    a, b, c = (skin.vertices[faces[:, corner]] for corner in range(3))
    blocks = np.stack([skew(c - b), skew(a - c), skew(b - a)], axis=1)  # by a, b and c
    # every corner's sum moves as the triangle's normal does
    entries = np.broadcast_to(blocks[:, None], (len(faces), 3, 3, 3, 3))
    rows = 3 * faces[:, :, None, None, None] + np.arange(3)[:, None]
    columns = 3 * faces[:, None, :, None, None] + np.arange(3)
    places = (np.broadcast_to(each, entries.shape).ravel() for each in (rows, columns))
    return sp.csr_array(sp.coo_array((entries.ravel(), tuple(places)), shape=(size, size)))


def shade_of(normals: Floats, blocked: Floats, light: Floats) -> Floats:
    """Return what skin of albedo 1 shows (n, 3), by its normals (n, 3) and ``blocked`` (n, 9)."""
    return np.asarray((BANDS * harmonics(normals) - blocked) @ light)


@dataclass(frozen=True)
class ShadingTerm(ImageTerm):
    """The differences between a picture and the skin under a light."""

    image: SmoothImage
    faces: Ints  # (f, 3) of the skin
    samples: SkinSamples
    albedo: Floats  # (n, 3) of the samples
    blocked: Floats  # (n, 9) of the light, at the samples
    light: Floats  # (9, 3)
    noise: float = 1.0  # standard deviation of a channel, of linear RGB
    share: float = 1.0  # of the face's visible skin that the samples are of

    def seen(self, skin: Floats, camera: PinholeCamera) -> Floats:
        """Return the picture's colours (n, 3) at the samples."""
        return self.image.at(camera.project(self.samples.of(skin))[:, :2])

    def residual(self, skin: Floats, camera: PinholeCamera) -> Floats:
        """See :class:`ImageTerm`: (3 n,), the channels of each sample in turn."""
        surface = Surface(skin, self.faces)
        shade = shade_of(normals_at(self.samples, surface), self.blocked, self.light)
        away = self.albedo * shade - self.seen(skin, camera)
        return np.asarray((away / self.noise).ravel())

    def linearise(self, skin: Floats, camera: PinholeCamera) -> LinearResidual:
        """See :class:`ImageTerm`."""
        surface = Surface(skin, self.faces)
        samples = self.samples
        points = samples.of(skin)
        count = len(skin)
        pixel_by_point, pixel_by_camera = camera.derivatives(points)
        moved = -self.image.rates(camera.project(points)[:, :2]) / self.noise
        sums = samples.of(vertex_sums(surface))
        length = np.linalg.norm(sums, axis=1)[:, None, None]
        normals = unit_rows(sums)
        turned = (np.eye(3) - normals[:, :, None] * normals[:, None]) / length
        light = BANDS[:, None] * self.light
        by_shade = np.einsum("bc,nbi->nci", light, harmonic_rates(normals)) @ turned
        by_shade *= self.albedo[:, :, None] / self.noise
        by_normal = by_vertices(by_shade, samples.corners, samples.weights, count)
        by_place = by_vertices(moved @ pixel_by_point, samples.corners, samples.weights, count)
        by_skin = sp.csr_array(by_normal @ sum_rates(surface) + by_place)
        by_camera = (moved @ pixel_by_camera).reshape(-1, pixel_by_camera.shape[2])
        return LinearResidual(self.residual(skin, camera), by_skin, by_camera)
