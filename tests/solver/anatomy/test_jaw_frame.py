"""The jaw's frame against motions that are known, and against the head's own jaw opening."""

import numpy as np
import pytest

from benchmarks.anatomy import jaw_residual
from solver.anatomy.bones import jaw_frame
from solver.anatomy.build import jaw_tracks
from solver.mechanics.boundary import move_jaw
from solver.templates import ict_facekit
from solver.templates.builtin.build import builtin_template
from tests.fixtures import data_folder, small_model

CONDYLES = np.array([[52.0, 20.0, 38.0], [-50.0, 21.0, 37.0]])


def test_axes_are_orthonormal_and_go_left_up_and_forward():
    frame = jaw_frame(CONDYLES)
    np.testing.assert_allclose(frame.axes @ frame.axes.T, np.eye(3), atol=1e-12)
    assert (np.diag(frame.axes) > 0.99).all()
    np.testing.assert_allclose(frame.origin, [1.0, 20.5, 37.5])


def test_known_motion_is_found_and_stretch_counts_as_not_rigid():
    frame = jaw_frame(CONDYLES)
    teeth = np.random.default_rng(0).uniform([-25, -50, 70], [25, -40, 110], (200, 3))
    b = np.array([0.4, 0.03, 1.0, -9.0, 8.0])
    moved = move_jaw(frame, teeth, b)
    found = jaw_residual(frame, teeth, moved)
    np.testing.assert_allclose(found.b, b, atol=1e-6)
    assert found.greatest < 1e-6
    assert found.not_rigid < 1e-6
    stretched = moved + 0.02 * (moved - moved.mean(axis=0))
    found = jaw_residual(frame, teeth, stretched)
    assert found.rms < 0.01
    assert found.not_rigid > 0.3


def test_roll_is_what_the_jaw_can_not_do():
    frame = jaw_frame(CONDYLES)
    teeth = np.random.default_rng(0).uniform([-25, -50, 70], [25, -40, 110], (200, 3))
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])
    assert jaw_residual(frame, teeth, teeth @ turn.T).rms > 1.0


def test_ict_jaw_opening_is_within_reach():
    kit = ict_facekit.read_facekit(data_folder("ict_facekit"))
    numbers = ict_facekit.LOWER_TEETH
    teeth = kit.skin.vertices[numbers.start : numbers.stop]
    moved = teeth + kit.deltas["jawOpen"][numbers.start : numbers.stop]
    found = jaw_residual(jaw_frame(CONDYLES), teeth, moved)
    assert found.rms < 0.1
    assert np.degrees(found.b[0]) == pytest.approx(25, abs=2)


def test_a_person_has_the_templates_tracks_in_its_own_size():
    template = builtin_template()
    model = small_model()
    found = jaw_tracks(template, model)
    assert found.frame is model.jaw
    apart = np.linalg.norm(template.condyles[0] - template.condyles[1])
    assert 0.9 < found.apart / apart < 1.1
    assert found.apart != apart
    # jawOpen of the built-in face slides its condyles 19 degrees downwards
    assert np.degrees(found.slope) == pytest.approx(19.2, abs=0.5)
    assert found.length > 10.0
