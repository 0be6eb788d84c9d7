"""Mixtures of shapes, fitted one after another as controls are learned from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from solver.animation.blendshapes import ShapedPose, keep_within
from solver.animation.controls.exact import MixtureFitOptions, MixtureTracker, fit_frames
from solver.fitting.drives.admissible import Admissible
from solver.fitting.face import Face, Pose
from solver.fitting.interior_point import FeasibleSet
from solver.surface import Floats
from tests.solver.block import block_model


@pytest.fixture(scope="module")
def face() -> Face:
    return Face(block_model())


@pytest.fixture(scope="module")
def motions(face: Face) -> Floats:
    """Of the face's points by two shapes: one of muscles, one of the jaw."""
    a = np.array([[s, 0.0, 0.0, s**-0.5, 0.0, s**-0.5] for s in (0.65, 0.8)])
    rest = face.rest_pose()
    poses = (Pose(a, rest.b), Pose(rest.a, np.array([0.12, 0.0, 0.0, 0.0, 0.0])))
    states = [face.continuation(face.rest, pose) for pose in poses]
    return np.array([face.face_points(state.x) - face.face_points(face.rest.x) for state in states])


def test_a_mixture_that_ends_far_off_is_fitted_again_where_it_has_come_to(
    face: Face, motions: Floats
) -> None:
    once, again, content = (
        MixtureTracker(face, motions, MixtureFitOptions(mm, rounds=1)) for mm in (np.inf, 0.0, 1.0)
    )
    off = []
    for weights in (np.array([1.0, 0.0]), np.array([0.0, 1.0])):
        fits = [each.fit(weights) for each in (once, again, content)]
        off = [np.inf if fit is None else fit.off_mm for fit in fits]
    # by the sensitivities at the mixture before, of the other shape alone
    assert off[0] > 0.01
    assert off[1] < 0.1 * off[0]
    assert off[2] == off[0]


def test_a_mixture_is_fitted_until_a_frames_steps_gain_no_more(face: Face, motions: Floats) -> None:
    frame, settled = (
        MixtureTracker(face, motions, MixtureFitOptions(rounds=rounds)) for rounds in (1, 8)
    )
    off = []
    for weights in (np.array([1.0, 0.0]), np.array([0.0, 1.0])):
        fits = [each.fit(weights) for each in (frame, settled, settled)]
        off = [np.inf if fit is None else fit.off_mm for fit in fits]
    assert off[1] < 0.9 * off[0]
    assert off[2] > 0.95 * off[1]


@dataclass(frozen=True)
class Beyond:
    """Shapes whose muscles go beyond what ``limits`` leave of them."""

    face: Face
    names: tuple[str, ...] = ("a", "b")

    def pose_of(self, weights: Floats, limits: FeasibleSet | None = None) -> ShapedPose:
        a, clamped = keep_within(np.tile([0.2, 0.0, 0.0, 1.0, 0.0, 1.0], (2, 1)), limits)
        return ShapedPose(a, np.zeros(5), clamped)


def test_frames_are_played_as_they_were_fitted_where_shapes_go_beyond_limits(
    face: Face, motions: Floats
) -> None:
    within = face.driven_as(Admissible())
    limits = within.layout.bounds.feasible
    shapes = Beyond(within)
    weights = np.array([[0.2, 0.0]])
    assert limits is not None
    by_name = dict(zip(shapes.names, motions, strict=True))
    changes, fitted = fit_frames(within, shapes, by_name, weights, np.array([True]), limits)
    assert fitted.all()
    played = shapes.pose_of(weights[0], limits).a + changes.activations[0]
    assert (limits.margins(played) > -1e-9).all()


def test_sensitivities_that_expired_are_made_anew_for_one_frame(
    face: Face, motions: Floats
) -> None:
    mixtures = MixtureTracker(face, motions)
    solver = mixtures.tracker.solver
    used = []
    for expires in (False, False, True, False):
        if expires:
            solver.expire()
        assert mixtures.fit(np.array([0.1, 0.0])) is not None
        used.append(solver.jacobian)
    assert used[0] is used[1]
    assert used[2] is not used[1]
    assert used[3] is used[2]
