"""Contraction: the part of their length that a muscle's fibres lose, and how surely it is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from solver.fitting.contraction import Contraction
from solver.fitting.face import Face
from solver.fitting.stretches import isochoric_activation
from solver.mechanics.flesh import IDENTITY
from tests.solver.block import block_model


@pytest.fixture(scope="module")
def contraction() -> Contraction:
    """Return that of two muscles with oblique fibres."""
    block = block_model()
    fibres = np.tile([0.6, 0.8, 0.0], (len(block.weights.data), 1))
    found = Contraction.of_face(Face(replace(block, fibres=fibres)))
    assert found is not None
    return found


def test_it_is_the_part_of_their_length_that_fibres_lose(contraction: Contraction) -> None:
    a = np.array([isochoric_activation(contraction.tensors[0], 0.7), IDENTITY])
    assert contraction(a) == pytest.approx([0.3, 0.0])
    frames = np.array([[IDENTITY, IDENTITY], a])
    np.testing.assert_allclose(contraction(frames), [[0.0, 0.0], [0.3, 0.0]], atol=1e-12)


def test_its_deviation_is_that_of_draws(contraction: Contraction) -> None:
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(12, 12))
    draws = np.tile(IDENTITY, 2) + rng.normal(size=(20_000, 12)) @ root.T
    found = contraction.sd(root @ root.T)
    assert found == pytest.approx(contraction(draws.reshape(-1, 2, 6)).std(axis=0), rel=0.03)


def test_muscles_without_fibres_have_none() -> None:
    bare = Contraction.of_face(Face(block_model()))
    assert bare is not None
    assert np.isnan(bare(np.tile(IDENTITY, (2, 1)))).all()
    assert np.isnan(bare.sd(np.eye(12))).all()
