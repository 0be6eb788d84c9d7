"""Many skins are few shapes and weights, every vertex of every frame within the limit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from solver.rig.frames.animation_gltf import SEQUENCE_BASIS, AnimatedSkin
from solver.rig.frames.skin_basis import Basis, span_skins
from solver.surface import Floats, Surface
from tests.solver.rig.frames.test_sequence_gltf import frame

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


def off_mm(skins: Floats, basis: Basis) -> Floats:
    """Return how far each skin (f,) is off its sum of shapes, blended in single precision."""
    shapes = basis.shapes.reshape(len(basis.shapes), -1)
    blended = np.tile(NEUTRAL.vertices, (len(skins), 1, 1))
    change = (basis.weights.astype(np.float32) @ shapes).reshape(len(skins), -1, 3)
    blended[:, basis.moving] += change
    return np.asarray(np.linalg.norm(blended - skins, axis=2).max(axis=1))


def test_every_skin_of_a_wide_motion_is_reached() -> None:
    skins = drifting_skins()
    basis = span_skins(NEUTRAL, skins.astype(np.float32), SEQUENCE_BASIS)
    assert off_mm(skins, basis).max() <= SEQUENCE_BASIS.within_mm + 1e-4
    assert (basis.weights.min(), basis.weights.max()) == (0.0, 1.0)
    np.testing.assert_array_equal(basis.weights[:, 0], 1.0)
    # no sum of large shapes that cancel: they are blended in single precision
    largest = np.linalg.norm(basis.shapes, axis=2).max(axis=1)
    assert (largest <= 2.0 * np.linalg.norm(skins - NEUTRAL.vertices, axis=2).max()).all()


def test_skins_that_were_not_sampled_are_reached() -> None:
    skins = drifting_skins()
    few = replace(SEQUENCE_BASIS, most_samples=4, more_samples=2)
    basis = span_skins(NEUTRAL, skins.astype(np.float32), few)
    assert off_mm(skins, basis).max() <= SEQUENCE_BASIS.within_mm + 1e-4


def test_a_coarser_basis_has_fewer_shapes() -> None:
    skins = drifting_skins()
    coarse = replace(SEQUENCE_BASIS, within_mm=0.8)
    bases = [
        span_skins(NEUTRAL, skins.astype(np.float32), each) for each in (coarse, SEQUENCE_BASIS)
    ]
    assert 1 < len(bases[0].shapes) < len(bases[1].shapes)
    assert off_mm(skins, bases[0]).max() <= 0.8 + 1e-4


def test_where_there_may_be_no_more_shapes_frames_are_off() -> None:
    skins = drifting_skins()
    few = replace(SEQUENCE_BASIS, most_shapes=4)
    basis = span_skins(NEUTRAL, skins.astype(np.float32), few)
    assert len(basis.shapes) == 5  # and what they count from
    assert off_mm(skins, basis).max() > SEQUENCE_BASIS.within_mm


def test_what_is_still_has_no_shapes() -> None:
    still = AnimatedSkin(NEUTRAL)
    still.add(frame(0), NEUTRAL.vertices)
    shapes, weights = still.morphs()
    assert (shapes, weights.shape) == ({}, (1, 0))
