"""Strips of broad muscles: a sheet, a ring, and what is narrow."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from solver.fitting.strips import StripOptions, split_broad, strip_names
from solver.mechanics.fibre_muscle import FibreMuscles
from tests.fixtures import small_model
from tests.solver.block import grid

ALONG = np.array([1.0, 0.0, 0.0])


def sheet(width, fibre_of):
    """A muscle in all tets of a sheet 60 mm long, with its vertices and tets."""
    vertices, tets = grid((20, round(width / 3.0), 1), (60.0, width, 3.0))
    fibres = fibre_of(vertices[tets].mean(axis=1))
    count = np.arange(len(tets))
    parts = np.zeros(len(tets), int), np.full(len(tets), 0.7), fibres, np.array([5.0])
    return vertices, tets, FibreMuscles(count, *parts, np.array([3]))


def test_a_sheet_is_split_along_its_fibres_and_a_band_is_not():
    options = StripOptions(breadth_mm=15.0)
    vertices, tets, whole = sheet(48.0, lambda at: np.tile(ALONG, (len(at), 1)))
    found = split_broad(vertices, tets, whole, options)
    assert found.sources.tolist() == [3, 3, 3]
    assert found.strengths.tolist() == [5.0, 5.0, 5.0]
    y = vertices[tets].mean(axis=1)[:, 1]
    spans = sorted((y[found.muscles == k].min(), y[found.muscles == k].max()) for k in range(3))
    assert all(after[0] > before[1] - 4.0 for before, after in pairwise(spans))
    volumes = np.bincount(found.muscles)
    assert volumes.min() > 0.7 * volumes.max()
    band = split_broad(*sheet(12.0, lambda at: np.tile(ALONG, (len(at), 1))), options)
    assert band.sources.tolist() == [3]
    np.testing.assert_array_equal(band.muscles, 0)


def test_a_ring_is_split_into_an_inner_and_an_outer_one():
    vertices, tets = grid((20, 20, 1), (80.0, 80.0, 4.0))
    at = vertices[tets].mean(axis=1) - [40.0, 40.0, 0.0]
    radius = np.linalg.norm(at[:, :2], axis=1)
    ring = np.flatnonzero((radius > 8.0) & (radius < 38.0))
    fibres = np.stack([-at[ring, 1], at[ring, 0], 0.0 * radius[ring]], axis=1)
    fibres /= np.linalg.norm(fibres, axis=1, keepdims=True)
    parts = np.zeros(len(ring), int), np.ones(len(ring)), fibres, np.ones(1), np.zeros(1, int)
    found = split_broad(vertices, tets, FibreMuscles(ring, *parts), StripOptions(breadth_mm=28.0))
    assert len(found.sources) == 2
    apart = [radius[ring][found.muscles == k] for k in (0, 1)]
    inner, outer = sorted(apart, key=np.median)
    assert np.quantile(inner, 0.9) < np.quantile(outer, 0.1) + 6.0


def test_strips_of_a_face_keep_every_entry_and_have_names():
    model = small_model()
    whole = FibreMuscles.of(model, model.weights, np.ones(model.muscle_count))
    found = split_broad(model.rest, model.tets, whole)
    assert len(found.sources) > model.muscle_count
    np.testing.assert_array_equal(found.sources[found.muscles], whole.muscles)
    np.testing.assert_array_equal(found.fractions, whole.fractions)
    names = strip_names(model.muscle_names, found)
    assert len(set(names)) == len(names) == len(found.sources)
    assert {"platysma_l.1", "platysma_l.2"} <= set(names)
    narrow = replace(found, sources=whole.sources, muscles=whole.muscles)
    assert strip_names(model.muscle_names, narrow) == model.muscle_names
