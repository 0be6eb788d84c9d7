"""The bump and what following it means."""

import numpy as np
import pytest

from benchmarks.artifact import add_bump, followed
from tests.solver.ball import ball


def test_a_bump_is_followed_by_its_own_height():
    scan = ball([0, 0, 0], 20.0)
    bumped, bump = add_bump(scan, centre=0)
    rise = np.linalg.norm(bumped.vertices, axis=1) - 20.0
    assert rise[0] == pytest.approx(6.0, abs=1e-6)
    far = np.linalg.norm(scan.vertices - scan.vertices[0], axis=1) >= 8.0
    assert np.array_equal(bumped.vertices[far], scan.vertices[far])
    assert 5 < len(bump.vertices) == (~far).sum()
    assert followed(bump, scan.vertices, bumped.vertices) == pytest.approx(1.0)
    assert followed(bump, scan.vertices, scan.vertices) == 0.0
    third = scan.vertices.copy()
    third[bump.vertices] += bump.heights[:, None] / 3.0 * bump.normals
    assert followed(bump, scan.vertices, third) == pytest.approx(1.0 / 3.0)
