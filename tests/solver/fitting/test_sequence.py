"""Frames one after the other against each frame on its own."""

import numpy as np
import pytest

from solver.fitting import activation
from solver.fitting.activation import ActivationOptions
from solver.fitting.face import Face, Pose
from solver.fitting.objective import Regulariser, SkinDistance, Target
from solver.fitting.tracking import Tracker
from solver.fitting.tracking.dense import DenseOptions, DensePoints, HeadAndFace, SeenPoints
from tests.solver.block import block_model

FRAMES = 40


@pytest.fixture(scope="module")
def face():
    return Face(block_model())


@pytest.fixture(scope="module")
def poses():
    """Both muscles contract and relax in turn while the jaw opens and shuts."""
    found = []
    for phase in np.linspace(0.0, 2.0 * np.pi, FRAMES):
        stretch = 1.0 - 0.15 * (1.0 - np.cos(phase + np.array([0.0, 1.0])))
        a = np.array([[s, 0.0, 0.0, s**-0.5, 0.0, s**-0.5] for s in stretch])
        found.append(Pose(a, np.array([0.06 * (1.0 - np.cos(phase)), 0.0, 0.0, 0.0, 0.0])))
    return found


@pytest.fixture(scope="module")
def targets(face, poses):
    """The skin of the poses, shaken a little so that no fit is perfect."""
    rng = np.random.default_rng(3)
    state = face.rest
    found = []
    for pose in poses:
        state = face.continuation(state, pose)
        points = face.face_points(state.x)
        found.append(Target.from_points(points + 0.1 * rng.standard_normal(points.shape)))
    return found


def seen(target):
    return SeenPoints(target.points, np.ones(len(target.points)))


def regulariser(face):
    return Regulariser(w_a=1e-3, w_v=1e-2, w_b=1e-6, prior=face.rest_pose())


@pytest.mark.long
def test_frames_are_as_good_as_on_their_own(face, targets):
    weights = regulariser(face)
    tracker = Tracker(DensePoints(face, weights))
    tracked = []
    alone = []
    for target in targets:
        tracker.step(seen(target))
        data = SkinDistance(face, target)
        tracked.append(activation.objective(data, weights, tracker.state))
        options = ActivationOptions(30, tolerance=1e-6)
        rest = face.rest
        alone.append(activation.fit(face, data, weights, rest, options).objective)
        assert face.flesh.count_inverted(tracker.state.x) == 0
        settled = face.solve_equilibrium(tracker.state.pose, tracker.state.x)
        assert np.abs(settled.x - tracker.state.x).max() < 0.05
    assert np.mean(tracked) < 1.02 * np.mean(alone)
    assert np.max(np.divide(tracked, alone)) < 1.1


def test_a_temporal_weight_holds_the_pose(face, targets):
    moved = []
    for weight in (0.0, 1e3):
        options = DenseOptions(temporal=weight)
        tracker = Tracker(DensePoints(face, regulariser(face), HeadAndFace(options=options)))
        a = []
        for target in targets[10:16]:
            tracker.step(seen(target))
            a.append(tracker.state.pose.a)
        moved.append(np.abs(np.diff(a[1:], axis=0)).max())
    assert moved[1] < 0.5 * moved[0]


def test_a_jump_is_fitted_the_long_way(face, targets):
    weights = regulariser(face)
    tracker = Tracker(DensePoints(face, weights))
    for target in (targets[0], targets[1], targets[20]):
        tracker.step(seen(target))
    data = SkinDistance(face, targets[20])
    alone = activation.fit(face, data, weights, face.rest).objective
    assert activation.objective(data, weights, tracker.state) < 1.05 * alone
