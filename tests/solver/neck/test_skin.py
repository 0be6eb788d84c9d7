"""A neck under the small person, and its skin between a torso that stands still and a head."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.errors import InputError
from solver.model import CondyleTracks
from solver.neck.anatomy import JOINTS
from solver.neck.builtin import builtin_neck
from solver.neck.place import PlaceOptions, find_rim, head_joint, place_neck
from solver.neck.posture import share_out
from solver.neck.skin import NeckSkin, two_bones
from solver.surface import Floats, Surface, area_normals
from tests.fixtures import small_model

MODEL = small_model()
JOINT = head_joint(MODEL)
RIM = find_rim(MODEL, JOINT)
PLACED = place_neck(MODEL, builtin_neck(), RIM)
SKIN = NeckSkin.of(MODEL, PLACED.neck, RIM)
POSES = [(0, 60, 0), (0, -60, 0), (40, 0, 0), (-40, 0, 0), (0, 0, 30), (0, 0, -30), (20, 40, 10)]


def matrices(degrees: tuple[float, ...]) -> Floats:
    turn = Rotation.from_rotvec(np.radians(degrees)).as_matrix()
    return share_out(PLACED.neck, turn).matrices


def test_the_neck_is_under_the_skull_and_goes_through_the_rim() -> None:
    centres = PLACED.neck.centres
    np.testing.assert_allclose(centres[-1], JOINT)
    assert JOINT[1] < MODEL.jaw.origin[1]
    assert JOINT[2] < MODEL.jaw.origin[2]
    assert (np.diff(centres[:, 1]) > 5.0).all()
    rim = MODEL.skin.vertices[RIM]
    assert rim[:, 2].min() < centres[0, 2] < rim[:, 2].max()
    told = PLACED.report()
    assert 0.75 <= told["scale"] <= 1.25
    assert abs(told["lean_deg"]) <= 25.0
    np.testing.assert_allclose(told["joints_mm"]["head"], JOINT, atol=0.05)


def test_a_neck_goes_with_a_person_who_is_moved_and_larger() -> None:
    shift = np.array([3.0, -40.0, 11.0])
    jaw = MODEL.jaw
    surface = MODEL.skin.with_vertices(MODEL.skin.vertices + shift)
    moved = replace(MODEL, skin=surface, jaw=replace(jaw, origin=jaw.origin + shift))
    there = place_neck(moved, builtin_neck(), find_rim(moved, head_joint(moved)))
    np.testing.assert_allclose(there.neck.centres, PLACED.neck.centres + shift, atol=1e-9)
    apart = 1.1 * PlaceOptions.condyles_mm
    wide = replace(jaw, tracks=CondyleTracks(slope=0.3, apart=apart, length=20.0, opening=0.9))
    larger = place_neck(replace(MODEL, jaw=wide), builtin_neck(), RIM)
    assert larger.placed.scale == pytest.approx(1.1)
    assert larger.neck.centres[0, 1] < PLACED.neck.centres[0, 1] - 5.0


def test_skin_that_ends_in_no_neck_is_refused() -> None:
    vertices = MODEL.skin.vertices
    faces = MODEL.skin.faces
    above = (vertices[faces][:, :, 1] > JOINT[1] + 10.0).all(axis=1)
    face_only = replace(MODEL, skin=Surface(vertices, faces[above]))
    with pytest.raises(InputError, match="ends in no neck") as caught:
        find_rim(face_only, JOINT)
    assert caught.value.code == "neck.skin"


def test_the_rim_is_the_torso_s_and_the_face_is_the_head_s() -> None:
    assert SKIN.places[RIM].max() == 0.0
    eyes = np.concatenate([MODEL.region("left_eyeball"), MODEL.region("right_eyeball")])
    for of_head in (MODEL.region("nose"), MODEL.region("forehead"), eyes):
        assert (SKIN.places[of_head] == JOINTS).all()
    assert SKIN.places[MODEL.region("chin")].min() > JOINTS - 0.5
    assert 0.0 < np.median(SKIN.places[MODEL.region("neck")]) < JOINTS
    for bone in (MODEL.cranium, MODEL.mandible):
        np.testing.assert_allclose(SKIN.flesh[bone], JOINTS)
    bones, weights = two_bones(SKIN.places)
    np.testing.assert_allclose((bones * weights).sum(axis=1), SKIN.places, atol=1e-12)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)


@pytest.mark.parametrize("degrees", POSES)
def test_the_rim_is_still_the_head_rigid_and_no_triangle_folds(degrees: tuple[float, ...]) -> None:
    by_body = matrices(degrees)
    rest = MODEL.skin.vertices
    skin = SKIN.skin(by_body)
    np.testing.assert_allclose(skin[RIM], rest[RIM], atol=1e-9)
    of_head = SKIN.places == JOINTS
    placed = rest[of_head] @ by_body[-1, :3, :3].T + by_body[-1, :3, 3]
    np.testing.assert_allclose(skin[of_head], placed, atol=1e-9)
    faces = MODEL.skin.faces[(SKIN.places[MODEL.skin.faces] < JOINTS).any(axis=1)]
    turns = SKIN.blends(by_body, SKIN.places)[:, :3, :3][faces].mean(axis=1)
    before = area_normals(rest, faces)
    after = area_normals(skin, faces)
    assert (np.einsum("fij,fj,fi->f", turns, before, after) > 0.0).all()
    ratios = np.linalg.norm(after, axis=1) / np.linalg.norm(before, axis=1)
    assert np.percentile(ratios, 1) > 0.3
    np.testing.assert_allclose(SKIN.unposed(by_body, skin), rest, atol=1e-6)


def test_skin_hangs_on_the_flesh_at_its_border_alone() -> None:
    pull = SKIN.pull()
    assert (pull >= 0.0).all()
    pulled = MODEL.rest[pull > 0.0]
    assert 0 < len(pulled) < 0.2 * len(MODEL.rest)
    assert pulled[:, 1].max() < JOINT[1] + 20.0
    loose = SKIN.loose.ids
    assert not np.isin(RIM, loose).any()
    carried = SKIN.carry_flesh(matrices((-30.0, 0.0, 0.0)))
    at_rest = SKIN.carry_flesh(matrices((0.0, 0.0, 0.0)))
    np.testing.assert_allclose(at_rest, MODEL.rest, atol=1e-9)
    assert np.linalg.norm(carried[MODEL.cut] - MODEL.rest[MODEL.cut], axis=1).max() > 5.0
