"""Regions of the mouth and eyes of the built-in head and of ICT-FaceKit's: where they lie."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from solver.anatomy.contact_regions import LOWER, UPPER, contact_regions, lips_apart
from solver.errors import InputError
from solver.surface import Surface, vertex_normals
from solver.templates import ict_facekit
from solver.templates.builtin.build import builtin_head
from solver.templates.builtin.build import named_regions as builtin_regions
from solver.templates.builtin.skull import OuterSkin
from solver.templates.ict_template import LANDMARKS, both_sides, named_regions
from tests.fixtures import data_folder


def builtin():
    try:
        head = builtin_head()
    except InputError as error:
        pytest.skip(error.message)
    own = head.part_vertices
    parts = {name: own[name] for name in ("upper_teeth", "lower_teeth")}
    parts |= {f"{side}_eyeball": own[f"{side}_eye"] for side in ("left", "right")}
    flesh = Surface(head.neutral, head.faces[head.part_faces["skin"]])
    sides = lips_apart(flesh, head.landmarks)
    named = builtin_regions(head, OuterSkin(head).visible_vertices, sides)
    del named["face"]
    return flesh, sides, parts, head.landmarks, named


def ict():
    kit = ict_facekit.read_facekit(data_folder("ict_facekit"))
    skin = kit.skin
    eyes = np.array(ict_facekit.EYEBALLS)
    across = skin.vertices[eyes, 0]
    parts = {
        "upper_teeth": np.array(ict_facekit.UPPER_TEETH),
        "lower_teeth": np.array(ict_facekit.LOWER_TEETH),
        "left_eyeball": eyes[across > 0],
        "right_eyeball": eyes[across < 0],
    }
    flesh = kit.part(ict_facekit.FLESH)
    landmarks = both_sides(LANDMARKS, skin.vertices)
    sides = lips_apart(flesh, landmarks)
    return flesh, sides, parts, landmarks, named_regions(skin.vertices, sides)


@pytest.fixture(scope="module", params=[builtin, ict])
def head(request):
    return request.param()


@pytest.mark.long
def test_lips_lie_on_the_teeth_and_lids_on_the_eyes(head):
    flesh, sides, parts, landmarks, _ = head
    skin = flesh.vertices
    regions = contact_regions(flesh, sides, parts, landmarks)
    middle = {name: skin[ids].mean(axis=0) for name, ids in regions.items()}
    assert all(len(ids) > 40 for ids in regions.values())
    for name, ids in regions.items():
        assert np.isin(ids, flesh.faces).all() == ("lid" in name or "lining" in name)
    for name, side in (("upper_lip_lining", UPPER), ("lower_lip_lining", LOWER)):
        assert (sides[regions[name]] == side).all()
    assert middle["upper_lip_lining"][1] > middle["lower_lip_lining"][1] + 8
    assert middle["upper_teeth"][1] > middle["lower_teeth"][1] + 8
    front = skin[landmarks["stomion_superius"], 2]
    assert skin[regions["upper_lip_lining"], 2].max() < front + 4
    for side, sign in (("left", 1), ("right", -1)):
        upper, lower = (middle[f"{side}_{which}_lid"] for which in ("upper", "lower"))
        assert upper[1] > lower[1] + 5
        assert sign * upper[0] > 20
        assert upper[2] > middle[f"{side}_eyeball"][2]
        ball = skin[regions[f"{side}_eyeball"]]
        centre = (ball.min(axis=0) + ball.max(axis=0)) / 2
        radius = np.median(np.linalg.norm(ball - centre, axis=1))
        for which in ("upper", "lower"):
            lid = skin[regions[f"{side}_{which}_lid"]]
            assert np.linalg.norm(lid - centre, axis=1).min() > radius - 0.3


@pytest.mark.long
def test_no_lip_has_vertices_of_the_other_one(head):
    flesh, sides, _, landmarks, named = head
    skin = flesh.vertices
    normals = vertex_normals(flesh)
    assert (sides[named["upper_lip"]] == UPPER).all()
    assert (sides[named["lower_lip"]] == LOWER).all()
    # where lips touch, skin that faces skin is the other lip's
    used = np.unique(flesh.faces)
    corner = skin[landmarks["cheilion_l"]]
    own = used[
        (np.abs(skin[used, 0]) < corner[0] + 1)
        & (skin[used, 2] > corner[2] - 12)
        & (np.linalg.norm(skin[used] - skin[landmarks["stomion_superius"]], axis=1) < 45)
    ]
    pairs = own[cKDTree(skin[own]).query_pairs(1.2, output_type="ndarray")]
    gap = skin[pairs[:, 1]] - skin[pairs[:, 0]]
    across = (gap * normals[pairs[:, 0]]).sum(axis=1) > 0.7 * np.linalg.norm(gap, axis=1)
    facing = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(axis=1) < -0.7
    touching = pairs[across & facing]
    assert len(touching) > 4
    assert (sides[touching[:, 0]] == -sides[touching[:, 1]]).all()
