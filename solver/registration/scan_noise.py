"""A scanner's own noise: how much of it there is, and a scan smoothed as far as that pays.

Noise is what differs from vertex to vertex without regard to its neighbours. With A the mean over
neighbours, (1 - A)^2 x is left of a scan x by neither a slope nor a bend, and of noise of deviation
s it leaves s |row|. Skin's relief that is no wider than some of the scan's edges looks the same and
is taken for noise: better too smooth than pores that nobody has.

Smoothing takes shape as well, the more the coarser a scan is. With n_k the normals after k means
and d_k what noise of that deviation does to them, their square error is about (Stein 1981)

    max(|n_k - n_0|^2 - |d_k - d_0|^2, 0) + |d_k|^2,

shape that is gone and noise that is left; the k with the least is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from solver.surface import Floats, Ints, Surface, adjacency, vertex_areas, vertex_normals

QUARTILE = 3.138  # deviation of normal numbers by that of which a quarter are smaller in size


@dataclass(frozen=True)
class NoiseOptions:
    """How a scan's noise is estimated and smoothed."""

    steps: tuple[int, ...] = (0, 1, 2, 4, 8, 16)  # of smoothing that are tried, 0 the first
    around: int = 12  # means over neighbours of what noise does, for an estimate in each place
    most: int = 100_000  # vertices by which noise is told
    seed: int = 0  # of noise that is added to see what it does


NOISE = NoiseOptions()


@dataclass(frozen=True)
class QuietScan:
    """A scan after smoothing; lengths in mm."""

    surface: Surface
    noise_mm: float  # of its vertices before, along the normals
    steps: int  # means over neighbours that were taken
    height_noise: Floats  # (n,) variance of what is left of it after these, mm^2
    turn_noise: Floats  # (n,) and of the normals, rad^2


def quieten(scan: Surface, skin: Ints, options: NoiseOptions = NOISE) -> QuietScan:
    """Return a scan in mm, smoothed by as many steps as bring its normals nearest to the skin's.

    Noise is what the vertices ``skin`` (k,) have, which are no hair or cloth.
    """
    count = len(scan.vertices)
    graph = adjacency(scan.faces, count)
    degree = np.asarray(graph.sum(axis=1)).ravel()
    mean = sp.csr_array(sp.diags_array(1.0 / np.maximum(degree, 1.0)) @ graph)
    normals = vertex_normals(scan)
    chosen = skin[:: len(skin) // options.most + 1]
    noise = _deviation(scan.vertices, normals, mean, chosen)
    drawn = noise * np.random.default_rng(options.seed).standard_normal((count, 1)) * normals
    areas = vertex_areas(scan.vertices, scan.faces)

    def size(turns: Floats) -> float:
        """Return the mean square of changes of normals (n, 3)."""
        return float(np.average((turns[skin] ** 2).sum(axis=1), weights=areas[skin]))

    points = scan.vertices
    taken = 0
    first: tuple[Floats, Floats] | None = None
    best: tuple[float, QuietScan] | None = None
    for steps in options.steps:
        for _ in range(steps - taken):
            points = 0.5 * (points + mean @ points)
            drawn = 0.5 * (drawn + mean @ drawn)
        taken = steps
        smooth = Surface(points, scan.faces)
        own = vertex_normals(smooth)
        turned = vertex_normals(smooth.with_vertices(points + drawn)) - own
        first = first or (own, turned)
        gone = max(size(own - first[0]) - size(turned - first[1]), 0.0)
        error = gone + size(turned)
        if best is not None and error >= best[0]:
            break
        left = np.column_stack([np.einsum("nd,nd->n", drawn, own) ** 2, (turned**2).sum(axis=1)])
        for _ in range(options.around):
            left = 0.5 * (left + mean @ left)
        best = error, QuietScan(smooth, noise, steps, left[:, 0], left[:, 1])
    assert best is not None, "some steps are tried"
    return best[1]


def _deviation(points: Floats, normals: Floats, mean: sp.csr_array, chosen: Ints) -> float:
    """Return the deviation of noise along the normals, mm, by the quarter that bends least."""
    once = sp.csr_array(sp.eye_array(len(points)) - mean)
    twice = once[chosen] @ once
    left = np.einsum("nd,nd->n", twice @ points, normals[chosen])
    length = np.sqrt(np.asarray(twice.multiply(twice).sum(axis=1)).ravel())
    return QUARTILE * float(np.percentile(np.abs(left) / np.maximum(length, 1e-12), 25.0))
