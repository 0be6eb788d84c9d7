"""Skins that come one by one are the few shapes and weights that are left of them."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from solver.rig.frames.skin_basis import SEQUENCE_BASIS, GrowingBasis, GrowingOptions
from solver.surface import Floats, Surface

BALL = trimesh.creation.icosphere(subdivisions=3, radius=90.0)
NEUTRAL = Surface(np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64))
FRAMES = 300


def drifting_skins() -> Floats:
    """Return a jaw that opens wide while a small fold wanders: nearly parallel from frame to frame.

    The first skin that is not the neutral is off it by little, and the fold by less.
    """
    skins = np.tile(NEUTRAL.vertices, (FRAMES, 1, 1))
    lower = np.clip(-NEUTRAL.vertices[:, 1] / 90.0, 0.0, 1.0)
    for number, skin in enumerate(skins):
        opened = 0.8 * (number / FRAMES) ** 2
        turn = Rotation.from_rotvec(lower[:, None] * [opened, 0.05 * np.sin(0.2 * number), 0.0])
        skin[:] = turn.apply(skin)
        centre = 90.0 * np.array([np.sin(0.07 * number), np.cos(0.05 * number), 0.5])
        fold = np.exp(-np.sum((NEUTRAL.vertices - centre) ** 2, axis=1) / 500.0)
        skin += 0.4 * fold[:, None] * NEUTRAL.vertices / 90.0
    return skins


def off_mm(skins: Floats, basis: GrowingBasis) -> Floats:
    """Return how far each skin (f,) is off its sum of shapes, blended in single precision."""
    shapes, weights = basis.orthonormal()
    blended = (weights.astype(np.float32) @ shapes).reshape(skins.shape)
    return np.asarray(np.linalg.norm(NEUTRAL.vertices + blended - skins, axis=2).max(axis=1))


def test_every_skin_of_a_wide_motion_is_reached() -> None:
    skins, basis = drifting_skins(), GrowingBasis(NEUTRAL)
    for skin in skins:
        basis.add(skin)
    assert off_mm(skins, basis).max() <= SEQUENCE_BASIS.within_mm + 1e-4
    shapes, weights = basis.orthonormal()
    products = shapes.astype(np.float64) @ shapes.T.astype(np.float64)
    np.testing.assert_allclose(products, np.eye(len(shapes)), atol=1e-6)
    largest = np.linalg.norm(shapes.reshape(len(shapes), -1, 3), axis=2).max(axis=1)
    motion = np.linalg.norm(skins - NEUTRAL.vertices, axis=2).max()
    assert (np.abs(weights).max(axis=0) * largest <= motion).all()


def test_in_the_end_fewer_shapes_are_left() -> None:
    fine, coarse = GrowingBasis(NEUTRAL), GrowingBasis(NEUTRAL, GrowingOptions(within_mm=0.8))
    skins = drifting_skins()
    for skin in skins:
        fine.add(skin)
        coarse.add(skin)
    assert 0 < len(coarse.orthonormal()[0]) < len(fine.orthonormal()[0])
    assert off_mm(skins, coarse).max() <= 0.8 + 1e-4


def test_where_there_may_be_no_more_shapes_frames_are_off() -> None:
    skins, basis = drifting_skins(), GrowingBasis(NEUTRAL, GrowingOptions(most_shapes=4))
    for skin in skins:
        basis.add(skin)
    assert len(basis.orthonormal()[0]) == 4
    assert off_mm(skins, basis).max() > SEQUENCE_BASIS.within_mm


def test_what_is_still_has_no_shapes() -> None:
    basis = GrowingBasis(NEUTRAL)
    basis.add(NEUTRAL.vertices)
    shapes, weights = basis.orthonormal()
    assert (shapes.shape, weights.shape) == ((0, NEUTRAL.vertices.size), (1, 0))
