"""Corrections with an old stiffness against a solve, and tets that a prediction turns over."""

import numpy as np
import pytest

from solver.fitting.face import Face, Pose
from solver.mechanics.equilibrium import CorrectorOptions, correct, untangle
from tests.solver.block import block_model

PULLED = np.array([[0.85, 0.0, 0.0, 0.85**-0.5, 0.0, 0.85**-0.5]] * 2)


@pytest.fixture(scope="module")
def face():
    return Face(block_model())


@pytest.mark.parametrize("opening", [0.02, 0.1])
def test_an_old_stiffness_leads_to_the_equilibrium(face, opening):
    rest = face.rest
    pose = Pose(PULLED, np.array([opening, 0.0, 0.0, 0.0, 0.0]))
    settled = face.continuation(rest, pose)
    x = settled.x.copy()
    x[face.flesh.free] += [0.0, 0.4, 0.8] * np.sin(0.2 * x[face.flesh.free])
    a = face.flesh_controls(pose.a)
    found = correct(face.flesh, face.linear, x, a, rest.equilibrium.factor)
    assert np.abs(x - settled.x).max() > 0.5
    assert np.abs(found.x - settled.x).max() < CorrectorOptions.close_mm


def test_crushed_tets_go_along_with_what_holds_them(face):
    flesh = face.flesh
    rest = face.model.rest
    moved = rest.copy()
    moved[face.model.mandible] += [0.0, 0.0, 6.0]
    moved[flesh.free] += np.random.default_rng(1).uniform(-0.1, 0.1, (len(flesh.free), 3))
    turned = flesh.jacobians(moved) <= 0.0
    asked = moved.copy()
    found = untangle(flesh, rest, moved)
    np.testing.assert_array_equal(moved, asked)
    assert turned.any()
    assert flesh.min_jacobian_ratio(rest, found) > 0.0
    assert (found[face.model.mandible] == moved[face.model.mandible]).all()
