"""Poses of a neck, its tables, and how a rotation is shared out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.anatomy.data import read_table
from solver.neck.anatomy import BODIES
from solver.neck.builtin import DATA, builtin_neck
from solver.neck.posture import share_out, within
from solver.similarity import Similarity

NECK = builtin_neck()
HEAD = Rotation.from_rotvec([0.4, -0.7, 0.2])


def test_a_pose_keeps_joints_together_and_its_turns():
    turns = NECK.shares * HEAD.as_rotvec()
    pose = NECK.pose(turns)
    np.testing.assert_allclose(pose.turns, turns, atol=1e-12)
    for joint in range(1, 8):  # a joint's centre is in the body above and in the one below
        centre = NECK.centres[[joint, joint]]
        above, below = pose.points(np.array([joint + 1, joint]), centre)
        np.testing.assert_allclose(above, below, atol=1e-9)
    torso = pose.points(np.array([0]), np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_array_equal(torso, [[1.0, 2.0, 3.0]])
    rest = NECK.pose(np.zeros((8, 3))).points(np.array([8]), np.array([[1.0, 2.0, 3.0]]))
    np.testing.assert_allclose(rest, [[1.0, 2.0, 3.0]], atol=1e-12)


def test_a_scaled_and_turned_neck_is_the_same_motion():
    placed = Similarity(1.2, Rotation.from_rotvec([0.1, 0.0, 0.2]).as_matrix(), np.ones(3) * 50.0)
    moved = NECK.moved(placed)
    assert moved.muscles[3].length == pytest.approx(1.2 * NECK.muscles[3].length)
    np.testing.assert_allclose(moved.landmarks["menton"], placed(NECK.landmarks["menton"][None])[0])
    assert moved.inertias[-1].trace() == pytest.approx(1.2**5 * NECK.inertias[-1].trace())


def test_the_head_gets_its_rotation_and_the_joints_their_shares():
    pose = share_out(NECK, HEAD.as_matrix())
    np.testing.assert_allclose(pose.head, HEAD.as_matrix(), atol=1e-6)
    angles = np.linalg.norm(pose.turns, axis=1)
    assert angles.argmax() == BODIES.index("C1") - 1  # turns are C1's first of all
    assert angles.max() > 0.3


def test_a_rotation_beyond_the_range_is_held_at_it():
    inside = 0.5 * NECK.head_range * (0.0, 1.0, 0.0)
    assert within(NECK, inside)[1] == 0.0
    held, beyond = within(NECK, 3.0 * inside)
    np.testing.assert_allclose(held, 2.0 * inside)
    assert beyond == pytest.approx(np.linalg.norm(inside))


def test_a_neck_that_only_nods_is_not_turned_otherwise():
    nods = replace(NECK, ranges=NECK.ranges * (1.0, 0.0, 0.0))
    for asked in ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0]):
        held, beyond = within(nods, np.array(asked))
        np.testing.assert_array_equal(held, asked)
        assert beyond == 0.0
    held, beyond = within(nods, np.array([0.0, 0.3, 0.0]))
    np.testing.assert_allclose(held, 0.0, atol=1e-8)
    assert abs(beyond - 0.3) < 1e-8


def test_the_builtin_neck_has_sources_and_fibres_of_use():
    known = {row["key"] for row in read_table("sources", DATA)}
    rows = [*read_table("muscles", DATA), *read_table("joints", DATA)]
    for row in rows:
        named = row["source"].replace(";", " ").split()
        assert named
        assert set(named) <= known
    assert len(NECK.muscles) >= 40
    for left, right in zip(NECK.muscles[::2], NECK.muscles[1::2], strict=True):
        np.testing.assert_array_equal(left.points * (-1.0, 1.0, 1.0), right.points)
        fibre = (left.length - left.tendon) / left.fibre
        assert 0.9 < fibre < 1.1, left.name
