"""The way from pose to pose."""

import numpy as np
import pytest

import solver.fitting.face as module
from solver.errors import SolveError
from solver.fitting.face import ContinuationOptions, Face
from tests.solver.block import block_model, poses


def far(*_args):
    """Stand before a fold, where Newton's steps to the next pose stay long however near it is."""
    raise SolveError("solve.far", "the equilibrium is too far for a few steps")


def test_a_pose_behind_a_fold_is_solved_for_before_it_is_given_up(monkeypatch):
    options = ContinuationOptions(smallest=0.25, min_ratio=np.inf)
    face = Face(block_model((5, 8, 3)), options=options)
    pose = poses(1)[0]
    straight = face.continuation(face.rest, pose)
    monkeypatch.setattr(module, "newton_predict", far)
    np.testing.assert_allclose(face.continuation(face.rest, pose).x, straight.x, atol=1e-3)
    with pytest.raises(SolveError, match="too far"):
        face.newton_continuation(face.rest, np.zeros(face.flesh.size), pose)
