"""A neck that follows a head: held, turned, pushed, and what it cannot do."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.errors import InputError, SolveError
from solver.neck.builtin import builtin_neck
from solver.neck.motion import MotionOptions, Push, follow, reachable
from solver.neck.posture import within
from solver.neck.reflex import ReflexOptions
from solver.neck.voluntary import VoluntaryOptions

NECK = builtin_neck()
PUSH = Push(0.2, 0.3, np.array([30.0, 0.0, 0.0]), np.array([0.0, 64.0, 105.0]))


def still(seconds: float, vector=(0.0, 0.0, 0.0)):
    times = np.arange(0.0, seconds, 0.02)
    return reachable(NECK, times, np.tile(vector, (len(times), 1)))


def turning(seconds: float):
    times = np.arange(0.0, seconds, 0.02)
    waves = np.sin(np.outer(times, [2.7, 1.9, 3.4])) * np.minimum(times, 1.0)[:, None]
    return reachable(NECK, times, waves * np.radians([12.0, 25.0, 10.0]))


@pytest.mark.long
def test_a_head_is_held_and_turned_by_muscles_within_their_bounds():
    assert follow(NECK, still(1.0)).off_deg.max() < 0.5
    assert follow(NECK, still(1.0, 0.5 * NECK.head_range * (0.0, 1.0, 0.0))).off_deg.max() < 1.5
    motion = follow(NECK, turning(4.0))
    assert motion.figures["rms_deg"] < 1.0
    assert motion.figures["max_deg"] < 3.0
    assert motion.activations.min() >= 0.0
    assert motion.activations.max() <= 1.0
    assert 0.0 < motion.activations.mean() < 0.15
    head = np.degrees(np.linalg.norm(motion.goal.vectors, axis=1)).max()
    assert head > 20.0  # there was something to follow


@pytest.mark.long
def test_the_published_law_holds_the_head_too():
    options = MotionOptions()
    springs = replace(options, hill=replace(options.hill, law="springs"))
    assert follow(NECK, still(0.6), springs).off_deg.max() < 0.5


@pytest.mark.long
def test_a_weak_neck_stays_within_its_range():
    """Its muscles stop the head too late: ligaments hold it."""
    weak = tuple(replace(each, strength=0.4 * each.strength) for each in NECK.muscles)
    neck = replace(NECK, muscles=weak)
    times = np.arange(0.0, 3.0, 0.02)
    phases = np.array([0.4, 0.0, 1.1])
    waves = np.sin(np.outer(times, [2.0, 1.7, 1.1]) + phases)
    motion = follow(neck, reachable(neck, times, 1.3 * neck.head_range * waves))
    assert motion.off_deg.max() > 5.0
    turned = [Rotation.from_matrix(motion.pose(k).head).as_rotvec() for k in range(len(times))]
    assert max(within(neck, vector)[1] for vector in turned) < np.radians(1.0)


@pytest.mark.long
def test_reflexes_resist_a_push_and_late_ones_stay_stable():
    def peak_and_end(reflex):
        off = follow(NECK, still(1.6), MotionOptions(reflex=reflex), pushes=[PUSH]).off_deg
        return off.max(), off[-10:].max()

    without = peak_and_end(ReflexOptions(strain=0.0, strain_rate=0.0))
    with_ = peak_and_end(ReflexOptions())
    late = peak_and_end(ReflexOptions(delay_s=0.025))
    assert without[0] > 5.0
    assert with_[0] < 0.6 * without[0]
    assert max(with_[1], late[1]) < 1.0


def test_a_short_push_acts_for_as_long_as_it_is_said_to():
    def turned(begin_s: float, seconds: float) -> float:
        push = Push(begin_s, begin_s + seconds, np.array([300.0, 0.0, 0.0]), PUSH.point)
        return float(follow(NECK, still(0.3), pushes=[push]).off_deg.max())

    at_once = turned(0.1, 0.001)
    assert at_once > 0.1
    assert turned(0.1013, 0.001) == pytest.approx(at_once, rel=0.3)
    assert turned(0.1, 0.002) == pytest.approx(2.0 * at_once, rel=0.3)


@pytest.mark.long
def test_cocontraction_activates_more_and_moves_nothing():
    tense = MotionOptions(voluntary=VoluntaryOptions(cocontraction=0.2))
    calm = follow(NECK, still(0.6))
    stiff = follow(NECK, still(0.6), tense)
    assert stiff.activations[-1].mean() > calm.activations[-1].mean() + 0.05
    assert stiff.off_deg.max() < 0.5


def test_the_same_goal_gives_the_same_motion():
    first, again = (follow(NECK, turning(0.4)) for _ in range(2))
    np.testing.assert_array_equal(first.turns, again.turns)
    np.testing.assert_array_equal(first.activations, again.activations)
    assert np.ptp(first.turns) > 0.01


@pytest.mark.long
def test_a_goal_beyond_the_range_is_held_counted_and_told():
    times = np.arange(0.0, 2.0, 0.02)
    vectors = np.outer(np.minimum(times, 1.0), 1.5 * NECK.head_range * (0.0, 1.0, 0.0))
    goal = reachable(NECK, times, vectors)
    (notice,) = goal.notices
    assert notice.code == "neck.range"
    assert notice.context["count"] == goal.held.sum() > 0
    assert notice.context["first_frame"] == int(np.argmax(goal.held))
    turned = np.degrees(follow(NECK, goal).pose(len(times) - 1).turns)
    assert np.isfinite(turned).all()
    reach = [np.linalg.norm(each / NECK.head_range) for each in goal.vectors]
    assert max(reach) <= MotionOptions().range_part + 1e-9


def test_a_fast_goal_is_slowed_and_gaps_are_crossed():
    times = np.arange(0.0, 1.0, 0.02)
    vectors = np.zeros((50, 3))
    vectors[20:, 1] = 0.8
    vectors[30:35] = np.nan
    goal = reachable(NECK, times, vectors)
    codes = {each.code: each for each in goal.notices}
    assert codes.keys() == {"neck.gap", "neck.speed"}
    assert codes["neck.speed"].context["first_frame"] == 20
    assert codes["neck.gap"].context == {"count": 5, "first_frame": 30}
    steps = np.degrees(np.abs(np.diff(goal.vectors[:, 1]))) / 0.02
    assert steps.max() == pytest.approx(600.0)
    assert goal.vectors[-1, 1] == pytest.approx(0.8)
    assert np.isfinite(goal.vectors).all()


def test_a_motion_that_blows_up_is_told():
    wild = replace(NECK, stiffness=1e5 * NECK.stiffness, damping=0.0 * NECK.damping)
    goal = reachable(wild, np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0], [0.1, 0.5, 0.2]]))
    with pytest.raises(SolveError) as caught:
        follow(wild, goal)
    assert caught.value.code == "neck.unstable"


@pytest.mark.parametrize(
    ("times", "vectors"),
    [([0.0, 0.0], np.zeros((2, 3))), ([0.0, 1e6], np.zeros((2, 3))), ([0.0], [[np.nan] * 3])],
)
def test_a_goal_without_sense_is_refused(times, vectors):
    with pytest.raises(InputError) as caught:
        reachable(NECK, np.array(times), np.array(vectors))
    assert caught.value.code == "neck.goal"
