"""A face that is edited: pinned, its bones displaced, its flesh grown."""

from dataclasses import replace

import numpy as np
import pytest

from solver.fitting.face import Face
from solver.surface import Surface
from tests.solver.ball import ball
from tests.solver.block import block_model, poses


@pytest.fixture(scope="module")
def model():
    """The block with a row of vertices that slides on the cranium, a plane behind it."""
    block = block_model((5, 8, 3))
    back = block.rest[:, 2] == 0.0
    sliding = np.flatnonzero(back & (block.rest[:, 1] > 15.0) & (block.rest[:, 1] <= 20.0))
    corners = np.array([[-99.0, -99, 0], [99, -99, 0], [99, 99, 0], [-99, 99, 0]])
    plane = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    return replace(block, sliding=sliding, bones={"cranium": plane})


def settled(face, pose):
    return face.continuation(face.rest, pose).x


def test_pinned_flesh_does_not_slide(model):
    pose = poses(1)[0]
    free, pinned = (settled(Face(model, pinned=pinned), pose) for pinned in (False, True))
    motion = (free - model.rest)[model.sliding]
    assert np.abs(motion[:, :2]).max() > 1.0
    assert np.abs(motion[:, 2]).max() < 0.02
    np.testing.assert_array_equal(pinned[model.sliding], model.rest[model.sliding])


def test_displaced_bones_take_what_is_held_and_what_slides_along(model):
    bones = np.zeros_like(model.rest)
    forward = np.array([0.0, 0.0, 2.0])
    bones[np.concatenate([model.cranium, model.mandible, model.sliding])] = forward
    face = Face(model, bones=bones)
    x = settled(face, face.rest_pose())
    np.testing.assert_allclose(x, model.rest + forward, atol=1e-4)
    b = np.array([0.1, 0.0, 0.0, 0.0, 1.0])
    held = face.held_positions(b)
    number = np.searchsorted(face.flesh.held, model.mandible)
    np.testing.assert_array_equal(held[number], face.mandible(b))
    step = 1e-6 * np.eye(5)
    rate = np.stack([(face.mandible(b + h) - face.mandible(b - h)) / 2e-6 for h in step], axis=-1)
    np.testing.assert_allclose(face.mandible_jacobian(b)[model.mandible], rate, atol=1e-6)


def test_displaced_flesh_slides_along_the_bone_under_it(model):
    """On a round bone: where the flesh was before, the bone looks elsewhere."""
    middle = model.rest.mean(axis=0)
    away = np.array([6.0, 4.0, 0.0])
    skull, moved = (
        replace(model, bones={"cranium": ball(centre, 60.0, 3)})
        for centre in (middle - [0.0, 0.0, 70.0], middle - [0.0, 0.0, 70.0] + away)
    )
    bones = np.zeros_like(model.rest)
    bones[np.concatenate([model.cranium, model.sliding])] = away
    before = Face(skull).flesh.sliding
    after = Face(moved, bones=bones).flesh.sliding
    np.testing.assert_allclose(after.normals, before.normals, atol=1e-9)
    np.testing.assert_allclose(after.points, before.points + away)


def test_grown_flesh_takes_more_room(model):
    growth = np.full(len(model.tets), 1.1)
    x = settled(Face(model, growth=growth), Face(model).rest_pose())
    plain = Face(model).flesh
    room = plain.volumes @ plain.jacobians(x) / plain.volumes.sum()
    assert 1.15 < room < 1.331
