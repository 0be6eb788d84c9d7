"""What full solves teach a reduced skin."""

import numpy as np

from solver.live.mending import Mend, Mender, MendOptions
from solver.live.smoothing import OneEuro, Smoother


def test_a_mended_skin_is_right_where_it_was_solved_and_better_beside():
    rng = np.random.default_rng(1)
    ways = rng.standard_normal((6, 4))

    def lacks(values, clues):
        return np.sin(values) @ ways[:4] + 0.3 * clues @ ways[4:]

    mender = Mender(MendOptions(most=60))
    frames = [(rng.uniform(0.0, 1.0, 4), 0.2 * rng.standard_normal(2)) for _ in range(90)]
    for values, clues in frames[:80]:
        mender.add(values, clues, lacks(values, clues))
    mend = mender.mend()
    assert mend is not None
    assert len(mend.at) == 60
    left = [np.linalg.norm(lacks(*frame) - mend(*frame)) for frame in frames]
    whole = np.mean([np.linalg.norm(lacks(*frame)) for frame in frames])
    assert np.mean(left[70:80]) < 0.05 * whole
    assert np.mean(left[80:]) < 0.2 * whole


def test_what_was_solved_is_known_to_the_session_that_goes_on():
    rng = np.random.default_rng(5)
    before = Mender()
    for _ in range(7):
        before.add(rng.standard_normal(4), rng.standard_normal(2), rng.standard_normal(3))
    after = Mender()
    assert after.frames is None
    after.begin(before.frames)
    frame = np.ones(4), np.ones(2)
    assert np.abs(before.mend()(*frame)).max() > 0.01
    np.testing.assert_array_equal(after.mend()(*frame), before.mend()(*frame))


def test_nothing_solved_mends_nothing():
    assert not Mend.nothing(6, 4)(np.ones(4), np.ones(2)).any()


def test_a_smoother_calms_noise_and_is_late_by_a_frame_at_most():
    rng = np.random.default_rng(2)
    smooth = Smoother(OneEuro(1.0), np.ones(1))
    still = np.array([smooth(0.01 * rng.standard_normal(1), 1 / 60) for _ in range(400)])
    assert still[100:].std() < 0.007
    smooth.begin()
    ramp = [smooth(np.array([0.1 * frame]), 1 / 60)[0] for frame in range(60)]
    assert 0.1 * 59 - ramp[-1] < 0.1 + 1e-6
