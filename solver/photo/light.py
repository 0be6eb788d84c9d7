"""The light of a photograph and the skin's albedo, which together make its colours.

    min over gamma, A    sum_i |A_i * gamma^T (Y(n_i) - s_i) - I_i|^2 + smooth sum_ij |A_i - A_j|^2

Linear in either: the nine numbers of each channel's light and the albedo A of the skin's vertices
are solved for in turn (Ramamoorthi and Hanrahan 2001 for the light). Light times a constant and
albedo over it are the same picture: the mean albedo is 1. Smooth albedo leaves to shape what
changes quickly along the skin.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import igl
import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, maximum_filter, minimum_filter

from solver.anatomy.skin_points import SkinSamples
from solver.drawing.render import rasterise, sphere
from solver.photo.camera import PinholeCamera
from solver.photo.shading import BANDS, CHANNELS, facing, harmonics, normals_at
from solver.surface import Floats, Ints, Surface

FAR_MM = 1e6  # where nothing is seen
TURN_DIRECTIONS = 50  # of which the matrix of a turned light is made, which is exact


@dataclass(frozen=True)
class PixelOptions:
    """Options that choose the pixels of the skin that are compared."""

    outline_px: int = 3  # pixels so near to an outline or a step in depth are left out
    step_mm: float = 4.0  # of depth between neighbouring pixels, that is a step
    least_cosine: float = 0.3  # between normal and view: at grazing angles errors of shape win
    range: tuple[float, float] = (0.01, 0.97)  # linear RGB; beyond, a sensor tells nothing
    least: int = 50  # samples of which light and colours can be made


@dataclass(frozen=True)
class LightOptions:
    """Options of separating albedo and light."""

    smooth: float = 3.0  # price of albedo's differences along the skin, by samples a vertex
    rounds: int = 8  # of light and albedo in turn


@dataclass(frozen=True)
class Appearance:
    """A light (9, 3), and the albedo (V, 3) of the skin's vertices, whose mean is 1.

    The light is by harmonics of directions in the head's axes.
    """

    light: Floats
    albedo: Floats

    def turned(self, rotation: Floats) -> Appearance:
        """Return the same light in axes to which ``rotation`` (3, 3) takes directions."""
        directions = sphere(TURN_DIRECTIONS)
        # each degree is turned by itself, so that what skin gathers of it does not matter
        by_turned = np.linalg.pinv(harmonics(directions)) @ harmonics(directions @ rotation)
        return replace(self, light=by_turned @ self.light)


class VisibleSkin(NamedTuple):
    """Points of the skin that a picture shows well enough to be compared with it."""

    samples: SkinSamples
    share: float  # of all the places where the picture should show that skin


def visible_samples(
    skin: Surface,
    vertices: Ints,
    camera: PinholeCamera,
    pixels: Floats,
    every_px: int,
    mask: NDArray[np.bool_] | None = None,
    options: PixelOptions = PixelOptions(),
) -> VisibleSkin:
    """Return points of the skin that a picture (h, w, 3), linear RGB, shows: a grid of its pixels.

    ``vertices`` are those of the skin that count, ``mask`` (h, w) pixels that may.
    """
    height, width = pixels.shape[:2]
    projected = camera.project(skin.vertices)
    seen = rasterise(projected, skin.faces, width, height)
    depth = np.full((height, width), FAR_MM)
    depth[seen.mask] = seen.interpolate(projected[:, 2:])[:, 0]
    size = 2 * options.outline_px + 1
    flat = maximum_filter(depth, size) - minimum_filter(depth, size)
    # over so many pixels skin at the least cosine rises by this much
    rise = size * float(np.median(depth[seen.mask])) / camera.focal.mean() / options.least_cosine
    usable = binary_erosion(seen.mask, iterations=options.outline_px)
    usable &= flat < options.step_mm + rise
    low, high = options.range
    usable &= (pixels.min(axis=2) > low) & (pixels.max(axis=2) < high)
    if mask is not None:
        usable &= mask
    grid = np.zeros_like(usable)
    grid[every_px // 2 :: every_px, every_px // 2 :: every_px] = True
    rows, columns = np.nonzero(seen.mask & grid)
    corners = skin.faces[seen.triangle[rows, columns]]
    counts = np.isin(corners, vertices).all(axis=1)
    shown = int(counts.sum())
    counts &= usable[rows, columns]
    weights = seen.weights[rows, columns].astype(float)
    samples = SkinSamples(corners[counts], weights[counts])
    faces_us = facing(samples, skin, camera) > options.least_cosine
    samples = SkinSamples(samples.corners[faces_us], samples.weights[faces_us])
    return VisibleSkin(samples, len(samples.corners) / max(shown, 1))


def find_appearance(
    skin: Surface,
    samples: SkinSamples,
    colours: Floats,
    blocked: Floats,
    options: LightOptions = LightOptions(),
) -> Appearance:
    """Return light and albedo that make the ``colours`` (n, 3), linear RGB, of samples.

    ``blocked`` (V, 9) is what the skin blocks of the light.
    """
    basis = BANDS * harmonics(normals_at(samples, skin)) - samples.of(blocked)
    matrix = samples.matrix(len(skin.vertices))
    roughness = sp.csr_array(-igl.cotmatrix(skin.vertices, skin.faces))
    # what is not seen is as what is next to it; far parts without any link are at the mean
    density = len(colours) / max(len(np.unique(samples.corners)), 1)
    held = options.smooth * density * roughness + 1e-6 * sp.eye_array(len(skin.vertices))
    albedo = np.ones((len(skin.vertices), CHANNELS))
    light = np.zeros((basis.shape[1], CHANNELS))
    for _ in range(options.rounds):
        tint = samples.of(albedo)
        for channel in range(CHANNELS):
            design = tint[:, channel, None] * basis
            light[:, channel] = np.linalg.lstsq(design, colours[:, channel], rcond=1e-4)[0]
        shade = basis @ light
        for channel in range(CHANNELS):
            weighted = sp.diags_array(shade[:, channel]) @ matrix
            right = weighted.T @ colours[:, channel] + 1e-6
            system = sp.csc_array(weighted.T @ weighted + held)
            albedo[:, channel] = scipy.sparse.linalg.spsolve(system, right)
        scale = samples.of(albedo).mean(axis=0)
        albedo = albedo / scale
        light = light * scale
    return Appearance(light, albedo)
