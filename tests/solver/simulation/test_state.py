"""What is asked for on the way from one moment to the next."""

import numpy as np

from solver.similarity import small_motion
from solver.simulation.forces import Drive

BEFORE = Drive(
    1.0,
    np.ones((2, 6)),
    np.zeros(5),
    small_motion(np.array([0.3, -1.2, 0.5, 70.0, -30.0, 10.0])),
    (np.zeros((1, 3)),),
)
AFTER = Drive(
    2.0,
    np.full((2, 6), 3.0),
    np.ones(5),
    small_motion(np.array([0.9, 0.4, -0.5, 90.0, -30.0, 10.0])),
    (np.ones((1, 3)),),
)


def test_half_of_the_way_is_half_of_everything_and_of_the_turn():
    half = BEFORE.toward(AFTER, 0.5)
    assert half.time == 1.5
    np.testing.assert_array_equal(half.A, 2.0)
    np.testing.assert_array_equal(half.jaw, 0.5)
    np.testing.assert_array_equal(half.objects[0], 0.5)
    np.testing.assert_allclose(half.head.shift, [80.0, -30.0, 10.0])
    turn = half.head.rotation @ BEFORE.head.rotation.T
    np.testing.assert_allclose(turn @ half.head.rotation, AFTER.head.rotation, atol=1e-12)
    assert np.degrees(np.arccos((np.trace(turn) - 1.0) / 2.0)) > 30.0


def test_ways_have_their_ends():
    assert BEFORE.toward(AFTER, 1.0) is AFTER
    start = BEFORE.toward(AFTER, 0.0)
    np.testing.assert_allclose(start.head.rotation, BEFORE.head.rotation, atol=1e-12)
