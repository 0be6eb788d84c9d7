"""Centre lines: along open muscles, around rings, and the derivatives of their lengths."""

from dataclasses import replace

import numpy as np

from solver.tracks.lines import CentreLines, LineOptions
from tests.solver.block import dense_pattern
from tests.solver.tracks.block import tracked_block


def test_a_line_follows_the_fibres_from_end_to_end():
    model = tracked_block((20, 4, 3))
    lines = CentreLines.of(model)
    first, last = lines.first[:2]
    points = lines.points(model.rest)[first:last]
    assert not lines.closed.any()
    assert len(points) >= 4
    assert (np.diff(points[:, 0]) > 0.0).all()
    # the muscle is as wide as the block all along
    assert np.allclose(points[:, 1], 20.0, atol=1.0)
    length = lines.lengths(model.rest)
    assert np.isclose(length[0], points[-1, 0] - points[0, 0], rtol=0.01)
    assert np.allclose(lines.rows.sum(axis=1), 1.0)


def test_lengths_are_those_of_the_stretched_flesh():
    model = tracked_block()
    lines = CentreLines.of(model)
    rest = lines.lengths(model.rest)
    assert np.allclose(lines.lengths(1.2 * model.rest) / rest, 1.2)
    # slices of few tets are not quite across: the line winds a little
    assert np.allclose(lines.lengths(model.rest * [1.2, 1.0, 1.0]) / rest, 1.2, rtol=0.01)


def test_rates_are_the_derivatives_of_lengths():
    model = tracked_block()
    random = np.random.default_rng(3)
    lines = CentreLines.of(model)
    x = model.rest + random.standard_normal(model.rest.shape)
    motion = random.standard_normal((*model.rest.shape, 2))
    found = lines.length_rates(x, motion)
    h = 1e-6
    for column in range(2):
        step = h * motion[:, :, column]
        expected = (lines.lengths(x + step) - lines.lengths(x - step)) / (2.0 * h)
        assert np.abs(expected).min() > 1e-3
        assert np.allclose(found[:, column], expected, rtol=1e-6)


def test_the_line_of_a_ring_is_closed():
    model = tracked_block((10, 8, 2))
    arm = model.tet_centres - [25.0, 20.0, 7.5]
    radius = np.hypot(arm[:, 0], arm[:, 1])
    share = ((radius > 8.0) & (radius < 18.0)).astype(float)
    weights = dense_pattern(np.stack([1.0 - share, share], axis=1))
    around = np.stack([-arm[:, 1], arm[:, 0], np.zeros(len(arm))], axis=1) / radius[:, None]
    fibres = np.zeros((weights.nnz, 3))
    fibres[weights.indices == 1] = around
    ring = replace(model, weights=weights, fibres=fibres, muscle_names=("ring",))
    lines = CentreLines.of(ring)
    assert lines.closed.tolist() == [True]
    points = lines.points(ring.rest)
    assert len(points) == LineOptions().most_points
    away = np.linalg.norm(points[:, :2] - [25.0, 20.0], axis=1)
    assert away.min() > 8.0
    # around the hole once: no segment is missing
    length = lines.lengths(ring.rest)[0]
    assert 0.9 * 2.0 * np.pi * away.mean() < length < 1.3 * 2.0 * np.pi * away.mean()


def test_muscles_without_flesh_have_no_line():
    model = tracked_block()
    share = model.weights.toarray()
    share[:, 0] += share[:, 2]
    share[:, 2] = 0.0
    lines = CentreLines.of(replace(model, weights=dense_pattern(share)))
    assert np.diff(lines.first)[1] == 0
    assert lines.lengths(model.rest)[1] == 0.0
