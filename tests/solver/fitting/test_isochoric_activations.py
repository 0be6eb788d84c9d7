"""Six numbers of a symmetric matrix, and muscles that keep their volume."""

from __future__ import annotations

import numpy as np
import pytest

from solver.fitting.stretches import FROBENIUS, isochoric_activation, matrices


def test_fibres_shorten_and_the_volume_stays() -> None:
    along = np.array([2.0, -1.0, 2.0]) / 3.0
    straight = matrices(isochoric_activation(np.outer(along, along), 0.8)[None])[0]
    np.testing.assert_allclose(straight @ along, 0.8 * along, atol=1e-12)
    assert np.linalg.det(straight) == pytest.approx(1.0)
    ring = matrices(isochoric_activation(np.diag([0.5, 0.5, 0.0]), 0.8)[None])[0]
    np.testing.assert_allclose(np.diag(ring), [0.8**0.5, 0.8**0.5, 1 / 0.8])


def test_the_norm_of_six_numbers_is_that_of_their_matrix() -> None:
    a = np.random.default_rng(3).normal(size=(4, 6))
    np.testing.assert_allclose(a**2 @ FROBENIUS, np.sum(matrices(a) ** 2, axis=(1, 2)))
