"""Muscles that only contract along their fibres."""

from dataclasses import replace

import numpy as np
import pytest

from solver.errors import InputError
from solver.fitting.drives.fibre_contraction import (
    ContractionLimits,
    fibre_activations,
    nearest_fibre,
)
from solver.mechanics.flesh import IDENTITY
from tests.solver.block import block_model


def fibred_block():
    """Return the block, the left muscle's fibres along x, the right one's at random."""
    block = block_model()
    rng = np.random.default_rng(3)
    fibres = rng.normal(size=(block.weights.nnz, 3))
    fibres /= np.linalg.norm(fibres, axis=1, keepdims=True)
    columns = block.weights.indices
    fibres[columns == 0] = 0.0
    fibres[columns == 1] = [1.0, 0.0, 0.0]
    return replace(block, fibres=fibres)


@pytest.fixture(scope="module")
def model():
    return fibred_block()


def matrices(a):
    xx, xy, xz, yy, yz, zz = a.T
    return np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)


def test_relaxed_muscles_leave_flesh_at_rest(model):
    A = fibre_activations(model, model.weights, np.ones(2))
    np.testing.assert_allclose(A, np.tile(IDENTITY, (len(model.tets), 1)), atol=1e-15)


def test_a_tet_is_the_sum_of_its_muscles_and_passive_flesh(model):
    gamma = np.array([0.6, 1.2])
    A = matrices(fibre_activations(model, model.weights, gamma))
    dense = model.weights.toarray()
    fibres = model.fibres.reshape(len(model.tets), 3, 3)  # every column is stored
    for tet in (0, 17, len(model.tets) - 1):
        expected = dense[tet, 0] * np.eye(3)
        for muscle, g in enumerate(gamma, start=1):
            along = np.outer(fibres[tet, muscle], fibres[tet, muscle])
            contracted = g * along + g**-0.5 * (np.eye(3) - along)
            assert np.linalg.det(contracted) == pytest.approx(1.0)
            expected += dense[tet, muscle] * contracted
        np.testing.assert_allclose(A[tet], expected, atol=1e-14)


def test_contractions_are_found_again(model):
    a = np.tile(IDENTITY, (2, 1))
    a[0] = [0.7, 0.1, 0.0, 1.3, 0.0, 1.0]  # the shear is nothing along x
    a[1] = 0.8 * IDENTITY
    np.testing.assert_allclose(nearest_fibre(model, model.weights, a), [0.7, 0.8])
    a[0, 0] = 0.1
    assert nearest_fibre(model, model.weights, a)[0] == ContractionLimits.least


def test_a_muscle_without_flesh_stays_relaxed(model):
    S = model.weights.copy()
    S.data[S.indices == 2] = 0.0
    a = np.full((2, 6), 0.5)
    assert nearest_fibre(model, S, a)[1] == 1.0


def test_a_model_without_fibres_is_refused():
    block = block_model()
    with pytest.raises(InputError) as raised:
        fibre_activations(block, block.weights, np.ones(2))
    assert raised.value.code == "model.fibres"
