"""Harmonic fields over tets: exact where they have to be, least in energy, many at once."""

import numpy as np
import pytest
import scipy.sparse as sp

from solver.mechanics.flesh import shape_gradients
from solver.mechanics.harmonic import HarmonicExtension, laplacian
from solver.mechanics.linear import SOLVERS, NotPositiveDefiniteError, analyse
from tests.solver.block import grid


@pytest.fixture
def block():
    vertices, tets = grid((4, 3, 3), (8.0, 6.0, 6.0))
    gradients, volumes = shape_gradients(vertices, tets)
    return vertices, laplacian(gradients, volumes, tets, len(vertices))


def border(vertices):
    low = vertices.min(axis=0)
    high = vertices.max(axis=0)
    return ((vertices == low) | (vertices == high)).any(axis=1)


def test_the_energy_of_a_linear_field_is_its_slope_squared(block):
    vertices, K = block
    slope = np.array([0.3, -0.2, 0.5])
    u = vertices @ slope
    assert np.isclose(u @ (K @ u), slope @ slope * 8 * 6 * 6)
    assert np.allclose(K @ np.ones(len(vertices)), 0.0)


def test_linear_fields_are_continued_exactly(block):
    vertices, K = block
    given = border(vertices)
    assert 0 < given.sum() < len(given)
    fields = np.stack([vertices, 2.0 * vertices[:, [1, 2, 0]] + 1.0], axis=2)
    known = np.where(given[:, None, None], fields, np.nan)
    assert np.allclose(HarmonicExtension(K, given)(known), fields)


def test_many_fields_at_once_are_those_of_each_alone(block):
    vertices, K = block
    given = vertices[:, 0] == 0.0
    rows = picked(vertices[:, 0] == 8.0)
    extension = HarmonicExtension(K, given, rows, np.full(rows.shape[0], 5.0))
    random = np.random.default_rng(1)
    values = random.random((len(given), 4))
    targets = random.random((rows.shape[0], 4))
    both = extension(values, targets=targets)
    for column in range(4):
        alone = extension(values[:, column], targets=targets[:, column])
        assert np.allclose(both[:, column], alone, atol=1e-12)


def test_soft_constraints_are_the_least_of_the_stated_energy(block):
    vertices, K = block
    rows = picked(vertices[:, 0] == 8.0)
    given = vertices[:, 0] == 0.0
    weights = np.linspace(1.0, 3.0, rows.shape[0])
    targets = vertices[vertices[:, 0] == 8.0, 1]
    load = np.sin(np.arange(len(vertices)))
    u = HarmonicExtension(K, given, rows, weights)(np.ones(len(given)), targets=targets, load=load)

    def energy(field):
        missed = rows @ field - targets
        return 0.5 * field @ (K @ field) + 0.5 * weights @ missed**2 - load @ field

    assert np.allclose(u[given], 1.0)
    assert np.abs(rows @ u - targets).max() > 0.05
    for seed in range(3):
        way = np.where(given, 0.0, np.random.default_rng(seed).standard_normal(len(u)))
        ahead = energy(u + 1e-3 * way)
        behind = energy(u - 1e-3 * way)
        assert ahead > energy(u) < behind
        assert abs(ahead - behind) < 1e-9 * ahead


def test_what_nothing_holds_is_refused_or_zero(block):
    vertices, K = block
    two = sp.block_diag([K, K], format="csr")
    given = np.concatenate([vertices[:, 0] == 0.0, np.zeros(len(vertices), bool)])
    with pytest.raises(NotPositiveDefiniteError):
        HarmonicExtension(two, given)
    u = HarmonicExtension(two, given, trace=1e-9)(np.ones(len(given)))
    assert np.allclose(u[: len(vertices)], 1.0, atol=1e-6)
    assert np.allclose(u[len(vertices) :], 0.0)


def test_all_given_is_left_as_it_is(block):
    vertices, K = block
    assert np.array_equal(HarmonicExtension(K, np.ones(len(vertices), bool))(vertices), vertices)


@pytest.mark.parametrize("name", sorted(SOLVERS))
def test_every_linear_solver_takes_single_unknowns(block, name):
    vertices, K = block
    free = np.flatnonzero(vertices[:, 0] > 0.0)[:-2]  # no multiple of three
    inner = sp.csr_array(K[free][:, free])
    inner.sort_indices()
    try:
        found = analyse(inner, name, block=1).factor(inner.data).solve(np.ones(len(free)))
    except Exception as error:
        if getattr(error, "code", "") == "solver.missing":
            pytest.skip(str(error))
        raise
    assert len(free) % 3 != 0
    assert np.allclose(inner @ found, 1.0, atol=1e-4)


def picked(mask):
    """Return rows that pick the marked vertices."""
    numbers = np.flatnonzero(mask)
    ones = np.ones(len(numbers))
    return sp.csr_array((ones, (np.arange(len(numbers)), numbers)), shape=(len(numbers), len(mask)))
