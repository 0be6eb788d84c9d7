"""Contact regions of the built-in head and of ICT-FaceKit's: where they lie."""

import numpy as np
import pytest

from solver.anatomy import ict_facekit
from solver.anatomy.builtin import builtin_head
from solver.anatomy.contact_regions import contact_regions
from solver.anatomy.ict_depths import both_sides
from solver.anatomy.ict_regions import LANDMARKS
from solver.errors import InputError
from tests.fixtures import data_folder


def builtin():
    try:
        head = builtin_head()
    except InputError as error:
        pytest.skip(error.message)
    own = head.part_vertices
    parts = {name: own[name] for name in ("upper_teeth", "lower_teeth")}
    parts |= {f"{side}_eyeball": own[f"{side}_eye"] for side in ("left", "right")}
    return head.neutral, own["skin"], parts, head.landmarks


def ict():
    skin = ict_facekit.read_facekit(data_folder("ict_facekit")).skin.vertices
    eyes = np.array(ict_facekit.EYEBALLS)
    parts = {
        "upper_teeth": np.array(ict_facekit.UPPER_TEETH),
        "lower_teeth": np.array(ict_facekit.LOWER_TEETH),
        "left_eyeball": eyes[skin[eyes, 0] > 0],
        "right_eyeball": eyes[skin[eyes, 0] < 0],
    }
    return skin, np.array(ict_facekit.FLESH), parts, both_sides(LANDMARKS, skin)


@pytest.mark.parametrize("head", [builtin, ict])
def test_lips_lie_on_the_teeth_and_lids_on_the_eyes(head):
    skin, flesh, parts, landmarks = head()
    regions = contact_regions(skin, flesh, parts, landmarks)
    middle = {name: skin[ids].mean(axis=0) for name, ids in regions.items()}
    assert all(len(ids) > 40 for ids in regions.values())
    for name, ids in regions.items():
        assert np.isin(ids, flesh).all() == ("lid" in name or "lining" in name)
    assert middle["upper_lip_lining"][1] > middle["lower_lip_lining"][1] + 8
    assert middle["upper_teeth"][1] > middle["lower_teeth"][1] + 8
    front = skin[landmarks["stomion_superius"], 2]
    assert skin[regions["upper_lip_lining"], 2].max() < front + 4
    for side, sign in (("left", 1), ("right", -1)):
        upper, lower = (middle[f"{side}_{which}_lid"] for which in ("upper", "lower"))
        assert upper[1] > lower[1] + 5
        assert sign * upper[0] > 20
        assert upper[2] > middle[f"{side}_eyeball"][2]
