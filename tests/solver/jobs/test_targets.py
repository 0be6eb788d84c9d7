"""Targets of scans: normals are those of what is seen."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.jobs.fits import Targets
from tests.solver.block import head_block

MODEL = head_block((4, 3, 1))


def test_a_hole_does_not_bend_the_normals_around_it() -> None:
    turn = Rotation.from_rotvec([0.5, -0.3, 0.2])
    points = turn.apply(MODEL.skin.vertices)
    confidence = np.ones(len(points))
    points[6] = np.nan
    target = Targets(MODEL, "plane").of_points(points, confidence)
    assert target.normals is not None
    seen = target.weights > 0.0
    assert np.flatnonzero(~seen).tolist() == [6]
    np.testing.assert_allclose(target.normals[seen], [turn.apply([0.0, 0.0, 1.0])] * seen.sum())
    slid = points + turn.apply([3.0, 2.0, 0.0])
    assert target.value(np.nan_to_num(slid)) == pytest.approx(0.0, abs=1e-12)
    assert Targets(MODEL, "point").of_points(points, confidence).normals is None


def test_a_point_without_a_triangle_has_no_say() -> None:
    points = MODEL.skin.vertices.copy()
    beside = np.setdiff1d(MODEL.skin.faces[(MODEL.skin.faces == 0).any(axis=1)], [0])
    points[beside] = np.nan
    target = Targets(MODEL, "plane").of_points(points, np.ones(len(points)))
    assert target.weights[0] == 0.0
