"""Colours of skin that no scan shows: those of the other side, else smooth ones from around.

Colours of vertices are smoothed over the skin,

    min_c sum_v w_v |c_v - s_v|^2 + sum_edges |c_u - c_v|^2,

with s_v what is seen at a vertex, or at its mirror image. A texel that is not seen gets this smooth
colour and, where its mirror image is seen, what that one is off its own smooth colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from solver.anatomy.warp import MIRROR
from solver.registration.texels import Texels
from solver.registration.topology import Topology
from solver.surface import Floats, Ints, adjacency


@dataclass(frozen=True)
class FillOptions:
    """Options of filling in the colours of unseen skin."""

    symmetric_mm: float = 1.0  # a template's outer vertices lie so near their mirror images
    symmetric_share: float = 0.9  # this share of them, at least
    held: float = 30.0  # weight of a seen vertex against an edge
    held_by_mirror: float = 3.0  # weight of one whose mirror image is seen
    held_by_mean: float = 1e-6  # weight of the mean colour, for pieces that nobody sees
    surest: float = 0.3  # confidence from which on a texel keeps its own colour
    model: float = 0.5  # least confidence of a texel that the other side is filled from
    most_models: int = 400_000  # texels that are searched for the closest one


FILL = FillOptions()


@dataclass(eq=False)
class ColouredTexels(Texels):
    """Texels (t) with what is seen of a skin there."""

    colours: Floats  # (t, 3) sRGB in [0, 1], where they are seen
    confidence: Floats  # (t,) from 0, not seen, to 1

    @classmethod
    def bare(cls, texels: Texels) -> ColouredTexels:
        """Return texels of which nothing is seen yet."""
        count = len(texels.rows)
        return cls(**vars(texels), colours=np.zeros((count, 3)), confidence=np.zeros(count))


def fill(
    texels: ColouredTexels, topology: Topology, options: FillOptions = FILL
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return the colours (t, 3) of all texels, and which (t,) have them from the other side."""
    mirror = _mirror(topology, options)
    smooth = _smooth(texels, mirror, options)
    base = texels.at(smooth)
    kept = np.clip(texels.confidence / options.surest, 0.0, 1.0)
    filled = base.copy()
    mirrored = np.zeros(len(kept), bool)
    if mirror is not None:
        asked, models = _models(texels, topology, kept, options)
        filled[asked] += texels.colours[models] - base[models]
        mirrored[asked] = True
    kept = kept[:, None]
    return kept * texels.colours + (1.0 - kept) * filled, mirrored


def _mirror(topology: Topology, options: FillOptions) -> Ints | None:
    """Return the outer vertex (n,) at each one's mirror image, -1 for none; None: no symmetry."""
    rest = topology.template.skin.vertices
    outer = topology.outer
    apart, near = cKDTree(rest[outer]).query(rest[outer] * MIRROR)
    close = apart < options.symmetric_mm
    if close.mean() < options.symmetric_share:
        return None
    mirror = np.full(len(rest), -1)
    mirror[outer[close]] = outer[near[close]]
    return mirror


def _smooth(texels: ColouredTexels, mirror: Ints | None, options: FillOptions) -> Floats:
    """Return smooth colours (n, 3) of the skin's vertices."""
    skin = texels.skin
    count = len(skin.vertices)
    corners = skin.faces[texels.faces].ravel()
    shares = np.clip(texels.shares, 0.0, 1.0)
    weights = (texels.confidence[:, None] * shares).ravel()
    total = np.bincount(corners, weights, count)
    every = np.bincount(corners, shares.ravel(), count)
    repeated = np.repeat(texels.colours, 3, axis=0)
    sums = np.column_stack(
        [np.bincount(corners, weights * repeated[:, channel], count) for channel in range(3)]
    )
    seen = sums / np.maximum(total, 1e-12)[:, None]
    sure = total / np.maximum(every, 1e-12)
    held = options.held * sure
    if mirror is not None:
        has = mirror >= 0
        other = np.where(has, mirror, 0)
        reflected = options.held_by_mirror * np.where(has, sure[other], 0.0) * (1.0 - sure)
        summed = held + reflected
        share = (held / np.maximum(summed, 1e-12))[:, None]
        seen = share * seen + (1.0 - share) * seen[other]
        held = summed
    mean = np.average(seen, axis=0, weights=held) if held.any() else np.full(3, 0.5)
    graph = adjacency(skin.faces, count)
    stiffness = sp.diags_array(np.asarray(graph.sum(axis=1)).ravel() + held + options.held_by_mean)
    right = held[:, None] * seen + options.held_by_mean * mean
    return np.asarray(splu(sp.csc_array(stiffness - graph)).solve(right))


def _models(
    texels: ColouredTexels, topology: Topology, kept: Floats, options: FillOptions
) -> tuple[Ints, Ints]:
    """Return texels that are not quite seen, and for each the seen one at its mirror image."""
    rest = topology.template.skin.vertices
    models = np.flatnonzero(texels.confidence > options.model)
    models = models[:: max(1, -(-len(models) // options.most_models))]
    asked = texels.within(topology.outer)
    asked = asked[kept[asked] < 1.0]
    if not len(models) or not len(asked):
        return asked[:0], models[:0]
    tree = cKDTree(texels.at(rest, models))
    apart, near = tree.query(
        texels.at(rest, asked) * MIRROR, distance_upper_bound=options.symmetric_mm
    )
    found = np.flatnonzero(np.isfinite(apart))
    return asked[found], models[near[found]]
