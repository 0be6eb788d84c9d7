"""Strips of broad muscles, which contract on their own: a sheet's or a ring's fibres side by side.

A muscle is split along its fibres f by a function u that hardly changes along them, the smoothest
but for the constant:

    min int (f . grad u)^2 + slip |grad u|^2,    int u^2 = 1, int u = 0

in linear elements of its tets. It grows across a sheet from side to side, and across a ring from
within to without. A ring counts as broad as its two sides together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from solver.anatomy.build import fibre_laplacian
from solver.mechanics.fibre_muscle import FibreMuscles
from solver.mechanics.flesh import shape_gradients
from solver.surface import Floats, Ints, own_numbers, unit_rows


@dataclass(frozen=True)
class StripOptions:
    """Breadth of strips, and what is split."""

    breadth_mm: float = 20.0
    most: int = 4  # strips of a muscle
    least_tets: int = 12  # of a strip
    slip: float = 0.01  # weight of changes in any direction, by that of changes along fibres
    end: float = 0.1  # part of the muscle's tets that are its end by u
    ring: float = 0.6  # cosine to circles about the middle from which fibres make a ring


def split_broad(
    rest: Floats, tets: Ints, muscles: FibreMuscles, options: StripOptions = StripOptions()
) -> FibreMuscles:
    """Return muscles with the broad ones in strips, of the same strength, side by side."""
    of_entry = muscles.muscles.copy()
    sources: list[int] = []
    strengths: list[float] = []
    centres = rest[tets].mean(axis=1)
    for muscle, source in enumerate(muscles.sources):
        mine = np.flatnonzero((muscles.muscles == muscle) & (muscles.fractions > 0.0))
        every = np.flatnonzero(muscles.muscles == muscle)
        at = centres[muscles.tets[mine]]
        number = np.zeros(len(every), dtype=np.int64)
        if len(mine) >= 2 * options.least_tets:
            own = tets[muscles.tets[mine]]
            whole, across = _across(rest, own, muscles.fibres[mine], options)
            at = at[whole]
            fibres = muscles.fibres[mine][whole]
            sides = 2 if _roundness(at, fibres) > options.ring else 1
            wanted = round(sides * _breadth(at, fibres, across, options) / options.breadth_mm)
            count = max(1, min(wanted, options.most, len(at) // options.least_tets))
            bounds = np.quantile(across, np.linspace(0.0, 1.0, count + 1)[1:-1])
            strip = np.searchsorted(bounds, across)
            # what lies apart goes with what is nearest; so do candidates without volume
            number = strip[cKDTree(at).query(centres[muscles.tets[every]])[1]]
        of_entry[every] = len(sources) + number
        parts = int(number.max(initial=0)) + 1
        sources += [int(source)] * parts
        strengths += [float(muscles.strengths[muscle])] * parts
    return replace(
        muscles, muscles=of_entry, sources=np.array(sources), strengths=np.array(strengths)
    )


def strip_names(names: tuple[str, ...], muscles: FibreMuscles) -> tuple[str, ...]:
    """Return the names of muscles and of strips, ``frontalis_l.1``, by those of the model's."""
    counts = np.bincount(muscles.sources)
    seen = dict.fromkeys(names, 0)
    found = []
    for source in muscles.sources:
        name = names[source]
        seen[name] += 1
        found.append(f"{name}.{seen[name]}" if counts[source] > 1 else name)
    return tuple(found)


def neighbours(tets: Ints) -> tuple[Ints, Ints]:
    """Return the pairs of tets (t, 4) that share a face."""
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]], axis=2).reshape(-1, 3)
    order = np.lexsort(faces.T)
    same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
    return order[:-1][same] // 4, order[1:][same] // 4


def _across(rest: Floats, tets: Ints, fibres: Floats, options: StripOptions) -> tuple[Ints, Floats]:
    """Return the tets (k,) of the largest part of a muscle, and their u (k,)."""
    _, corners = own_numbers(tets)
    rows = np.repeat(np.arange(len(tets)), 4)
    joins = sp.csr_array((np.ones(len(rows)), (rows, corners.ravel())))
    part = connected_components(joins.T @ joins, directed=False)[1]
    inside = np.flatnonzero(part[corners[:, 0]] == np.bincount(part[corners[:, 0]]).argmax())
    gradients, volumes = shape_gradients(rest, tets[inside])
    used, corners = own_numbers(tets[inside])
    K = fibre_laplacian(gradients, volumes, corners, fibres[inside], options.slip).toarray()
    mass = np.bincount(corners.ravel(), np.repeat(volumes / 4.0, 4), len(used))
    found = scipy.linalg.eigh(K, np.diag(mass), subset_by_index=[1, 1])[1][:, 0]
    # its sign is chance: what lies further out and up comes last
    upward = np.abs(rest[used, 0]) + rest[used, 1]
    u = found * np.sign(found @ (mass * (upward - upward.mean())))
    return inside, u[corners].mean(axis=1)


def _roundness(centres: Floats, fibres: Floats, sectors: int = 8) -> float:
    """Return how well fibres follow circles about the middle, as a mean cosine: the worst sector's.

    A ring around a mouth has 0.66, one around an eye 0.9, the roundest sheet 0.5.
    """
    arms = centres - centres.mean(axis=0)
    first, second, axis = np.linalg.svd(arms, full_matrices=False)[2]
    turned = np.arctan2(arms @ second, arms @ first) / (2.0 * np.pi) + 0.5
    sector = np.minimum((sectors * turned).astype(np.int64), sectors - 1)
    cosine = np.abs(np.einsum("ei,ei->e", unit_rows(np.cross(axis, arms)), fibres))
    sums = np.bincount(sector, cosine, sectors)
    return float((sums / np.maximum(np.bincount(sector, minlength=sectors), 1)).min())


def _breadth(centres: Floats, fibres: Floats, across: Floats, options: StripOptions) -> float:
    """Return how far apart, mm square to the fibres, the ends of a muscle by u are."""
    ends = np.quantile(across, [options.end, 1.0 - options.end])
    low = across <= ends[0]
    high = across >= ends[1]
    way = centres[high][cKDTree(centres[high]).query(centres[low])[1]] - centres[low]
    # along a slender muscle u grows too, but the ends are not beside each other
    return float(np.median(np.linalg.norm(np.cross(way, fibres[low]), axis=1)))
