"""What closes the jaw pays for contracting while it is open, and for nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from solver.anatomy.jaw_openers import opener_contractions
from solver.fitting.contraction import Contraction
from solver.fitting.face import Face
from solver.fitting.jaw_closers import CloserOptions, SilentClosers
from solver.fitting.stretches import isochoric_activation
from solver.rig.report.certificate import jaw_motion
from tests.fixtures import small_model
from tests.solver.block import differences


@pytest.fixture(scope="module", params=["free", "on tracks"])
def face(request):
    face = Face(small_model())
    return face if request.param == "free" else face.with_jaw_on_tracks()


def pose_of(face, by, opening):
    """Every muscle contracted ``by`` a part of its length, and the jaw opened, rad."""
    pose = face.rest_pose()
    tensors = Contraction.of_face(face).tensors
    a = np.array([isochoric_activation(each, 1.0 - by) for each in tensors])
    b = pose.b.copy()
    b[0] = opening
    return replace(pose, a=a, b=b)


def test_closers_pay_in_an_open_jaw_alone(face):
    options = CloserOptions()
    closers = SilentClosers.of_face(face)
    silent = options.cocontraction
    names = {face.model.muscle_groups[number][:-2] for number in closers.numbers}
    assert names == {"masseter_superficial", "masseter_deep", "temporalis"}
    opening = jaw_motion(face.model, face.jaw.matrix(pose_of(face, 0.0, 0.15).b)).opening_mm
    assert opening > options.open_mm
    assert closers.value(pose_of(face, 0.2, 0.0)) == 0.0
    assert closers.value(pose_of(face, 0.9 * silent, 0.15)) == 0.0
    pulling = pose_of(face, 0.2, 0.15)
    beyond = Contraction.of_face(face)(pulling.a)[closers.numbers] - silent
    assert beyond.min() > 0.1
    price = 0.5 * options.price * beyond**2
    assert closers.value(pulling) == pytest.approx(price.sum())
    assert closers.without(closers.numbers[1:]).value(pulling) == pytest.approx(price[0])


def test_their_price_has_its_derivatives_by_muscles_and_jaw(face):
    closers = SilentClosers.of_face(face)
    rng = np.random.default_rng(1)
    options = closers.options
    pose = pose_of(face, 0.15, 0.05)
    pose = replace(pose, a=pose.a + 0.02 * rng.standard_normal(pose.a.shape))
    opening = jaw_motion(face.model, face.jaw.matrix(pose.b)).opening_mm
    assert options.ajar_mm < opening < options.open_mm
    found = closers.gradient(pose)
    assert np.abs(found[face.layout.joint_places]).max() > 1.0
    assert np.abs(found[closers.places]).max() > 1.0
    np.testing.assert_allclose(
        found, differences(closers.value, pose), atol=1e-5 * np.abs(found).max()
    )
    slopes = differences(closers.residuals, pose).T
    bends = closers.gauss_newton(pose)
    np.testing.assert_allclose(
        bends, closers.weight * slopes.T @ slopes, atol=1e-5 * np.abs(bends).max()
    )


def test_who_opens_the_jaw_shortens_by_it(face):
    opened = opener_contractions(face.model.jaw, face.jaw.matrix(pose_of(face, 0.0, 0.3).b))
    for muscle in ("digastric", "geniohyoid"):
        left = opened[f"left {muscle}"]
        right = opened[f"right {muscle}"]
        assert 0.1 < left < 0.6
        assert left == pytest.approx(right, abs=0.02)
    still = opener_contractions(face.model.jaw, np.eye(4))
    assert still == pytest.approx(dict.fromkeys(still, 0.0), abs=1e-12)
    # a condyle that slides forward is drawn by the pterygoid of its side
    frame = face.model.jaw
    ahead = np.eye(4)
    ahead[:3, 3] = 8.0 * frame.axes[2] - 4.0 * frame.axes[1]
    assert 0.1 < opener_contractions(frame, ahead)["left lateral pterygoid"] < 0.4
