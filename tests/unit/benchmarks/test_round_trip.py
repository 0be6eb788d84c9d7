"""The contractions that the round trip draws are what they are called."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.round_trip import contraction
from solver.fitting.stretches import matrices


def test_a_contraction_shortens_fibres_and_keeps_the_volume() -> None:
    along = np.array([2.0, -1.0, 2.0]) / 3.0
    straight = matrices(contraction(np.outer(along, along), 0.8)[None])[0]
    np.testing.assert_allclose(straight @ along, 0.8 * along, atol=1e-12)
    assert np.linalg.det(straight) == pytest.approx(1.0)
    ring = matrices(contraction(np.diag([0.5, 0.5, 0.0]), 0.8)[None])[0]
    np.testing.assert_allclose(np.diag(ring), [0.8**0.5, 0.8**0.5, 1 / 0.8])
