"""Joints of a chain: where they take points, in memory and in a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from solver.errors import SolveError
from solver.neck.builtin import builtin_neck
from solver.rig.frames.animation_gltf import AnimationOptions, write_animation_glb
from solver.rig.frames.joints import Joints, chain
from solver.surface import Surface

BALL = trimesh.creation.icosphere(subdivisions=3, radius=90.0)
NEUTRAL = Surface(np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64))
TIMES = np.arange(40) / 25.0


def carried() -> tuple[Joints, np.ndarray]:
    """Return joints that turn while a part of the skin swells, and the skins (f, v, 3)."""
    random = np.random.default_rng(3)
    height = NEUTRAL.vertices[:, 1]
    rest = np.array([[0.0, 0, 0], [0, -60, 5], [0, -10, 0], [0, 40, -5]])
    waves = np.sin(TIMES[:, None, None] * random.uniform(1.0, 6.0, (4, 3)))
    turns = 0.5 * waves
    turns[:, 0] = 0.0
    place = np.clip((height + 80.0) / 40.0, 0.0, 3.0)
    under = np.minimum(place.astype(int), 2)
    bones = np.stack([under, under + 1], axis=1)
    weights = np.stack([1.0 - place + under, place - under], axis=1)
    swell = 4.0 * np.sin(TIMES)[:, None, None] * (height > 20.0)[:, None]
    unposed = (NEUTRAL.vertices * (1.0 + swell / 90.0)).astype(np.float32)
    joints = Joints(("root", "a", "b", "tip"), rest, turns, bones, weights, unposed)

    steps = Rotation.from_rotvec(turns.reshape(-1, 3)).as_matrix().reshape(len(TIMES), 4, 3, 3)
    matrices = chain(rest, steps)
    blends = np.einsum("vk,fvkij->fvij", weights, matrices[:, bones])
    skins = np.einsum("fvij,fvj->fvi", blends[..., :3, :3], unposed) + blends[..., :3, 3]
    return joints, skins.astype(np.float32)


def test_a_chain_is_the_neck_s() -> None:
    neck = builtin_neck()
    random = np.random.default_rng(0)
    turns = random.uniform(-0.3, 0.3, (8, 3))
    pose = neck.pose(turns)

    steps = np.concatenate([np.eye(3)[None], Rotation.from_rotvec(turns).as_matrix()])
    rest = np.vstack([np.zeros(3), neck.centres])
    np.testing.assert_allclose(chain(rest, steps[None])[0], pose.matrices, atol=1e-9)


def test_a_skin_on_joints_reads_back(tmp_path: Path) -> None:
    joints, skins = carried()
    path = tmp_path / "animation.glb"
    heads = np.zeros((len(TIMES), 6))
    options = AnimationOptions()
    written = write_animation_glb(path, NEUTRAL, skins, heads, TIMES, joints=joints)
    assert written.shapes <= 3
    assert 1e-3 < written.max_error_mm < options.basis.within_mm + 2.0 * options.keys_mm
    with pytest.raises(SolveError) as caught:
        write_animation_glb(path, NEUTRAL, skins + 1.0, heads, TIMES, joints=joints)
    assert caught.value.code == "file.differs"
