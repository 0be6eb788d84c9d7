"""What recruitment tells of scans: a wrong name, one side, a motion that nobody's is."""

from dataclasses import replace

import numpy as np
import pytest

from solver.fitting.drives.fibre_contraction import FibreContraction
from solver.fitting.face import Face
from solver.fitting.objective import Target
from solver.fitting.recruitment_checks import check_recruitment
from solver.model import Expressions
from tests.fixtures import small_model

# x y of the bump of each, from the middle of the face over its size
PLACES = {
    "mouthSmileLeft": (0.25, -0.2),
    "mouthSmileRight": (-0.25, -0.2),
    "mouthFrownLeft": (0.2, -0.45),
    "mouthFrownRight": (-0.2, -0.45),
    "browInnerUp": (0.0, 0.4),
}


@pytest.fixture(scope="module")
def face():
    """A face whose expressions are large bumps, each at a place of its own."""
    model = small_model()
    points = model.skin.vertices[model.face]
    middle = (points.max(axis=0) + points.min(axis=0)) / 2.0
    at = (points - middle)[:, :2] / np.ptp(points[:, :2], axis=0)
    off = np.linalg.norm(at - np.array(list(PLACES.values()))[:, None], axis=2)
    bumps = 60.0 * np.exp(-((off / 0.12) ** 2))
    motions = (bumps[:, :, None] * [0.5, 0.5, 0.7]).astype(np.float32)
    return Face(replace(model, expressions=Expressions(tuple(PLACES), motions)))


def told(face, name, weights=None, **amounts):
    """Return the codes of what is told of a scan of a name, a sum of expressions."""
    model = face.model
    by = [amounts.get(each, 0.0) for each in PLACES]
    moved = model.skin.vertices[model.face] + np.tensordot(by, model.expressions.motions, 1)
    found = check_recruitment(face, {name: Target.from_points(moved, weights)})
    return {each.code: each.context for each in found}


SMILE = {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.8}
FROWN = {"mouthFrownLeft": 0.9, "mouthFrownRight": 0.8, "browInnerUp": 0.6}


@pytest.mark.parametrize("name", ["smile", "Smile_02", "AU12", "a scan", "blink"])
def test_of_what_a_name_says_nothing_is_told(face, name):
    assert told(face, name, **SMILE) == {}


def test_another_expression_than_the_name_says_is_told(face):
    found = told(face, "smile", **FROWN)
    assert list(found) == ["target.name"]
    assert found["target.name"]["units"] == "AU 6 + 12"
    assert "mouthFrownLeft" in found["target.name"]["shows"]
    assert list(told(face, "smile left", mouthSmileRight=0.9)) == ["target.name"]
    assert told(face, "sad", **FROWN) == {}


def test_a_side_that_does_nothing_is_told_where_it_is_seen(face):
    assert told(face, "smile", mouthSmileLeft=0.9)["target.one_sided"]["side"] == "right"
    assert told(face, "smile left", mouthSmileLeft=0.9) == {}
    left = (face.model.skin.vertices[face.model.face][:, 0] > 0.0).astype(float)
    assert told(face, "smile", left, mouthSmileLeft=0.9) == {}


def test_motion_of_no_expression_is_told_unless_it_is_noise(face):
    rest = face.model.skin.vertices[face.model.face]
    noise = np.random.default_rng(2).normal(size=rest.shape)
    for size, codes in ((3.0, ["target.unexplained"]), (0.3, [])):
        found = check_recruitment(face, {"smile": Target.from_points(rest + size * noise)})
        assert [each.code for each in found] == codes


def test_that_nobody_is_expected_is_told_with_the_reason(face):
    plain = Face(small_model())
    dumb = replace(small_model(), expressions=replace(face.model.expressions, names=("a",) * 5))
    target = Target.from_points(plain.model.skin.vertices[plain.model.face])
    for other, reason in (
        (plain, "keeps no expressions"),
        (Face(dumb), "has a unit of FACS"),
        (face.driven_by(FibreContraction(face.model)), "driven by contraction"),
    ):
        [found] = check_recruitment(other, {"smile": target})
        assert found.code == "recruitment.none"
        assert reason in found.message
