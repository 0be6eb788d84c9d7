"""An animated skin reads back as the skins that were put in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib
import trimesh
from scipy.spatial.transform import Rotation

from solver.rig.frames import SequenceFrame
from solver.rig.frames.animation_gltf import SEQUENCE_BASIS, AnimatedSkin
from solver.rig.frames.read_back import validate_glb
from solver.surface import Surface
from tests.solver.glb import shown_skins, tracks

BALL = trimesh.creation.icosphere(subdivisions=2, radius=90.0)
NEUTRAL = Surface(np.asarray(BALL.vertices, np.float64), np.asarray(BALL.faces, np.int64))
FRAMES = 12


def frame(number: int) -> SequenceFrame:
    head = np.array([0.0, 0.6 * number, 0.0, 5.0, 0.0, number])
    figures = {"mean_mm": 0.1, "p95_mm": 0.2, "max_mm": 0.3, "coverage": 1.0, "seconds": 0.1}
    pose = {"activations": np.zeros((1, 6)), "jaw": np.zeros(5), "head": head}
    return SequenceFrame(frame=number, status="fitted", inverted=0, iterations=1, **pose, **figures)


def test_skins_read_back(tmp_path: Path) -> None:
    wave = np.sin(0.05 * NEUTRAL.vertices)
    skins = [
        NEUTRAL.vertices + 4.0 * np.sin(number) * wave + 0.01 * number * NEUTRAL.vertices[:, ::-1]
        for number in range(FRAMES)
    ]
    animated = AnimatedSkin(NEUTRAL)
    for number, skin in enumerate(skins):
        animated.add(frame(number), skin)
    animated.write(tmp_path / "sequence.glb", 25.0)
    document = pygltflib.GLTF2().load(str(tmp_path / "sequence.glb"))
    names = document.meshes[0].extras["targetNames"]
    assert names == ["start", "shape_1", "shape_2"]
    assert validate_glb(tmp_path / "sequence.glb", names) == []
    moves = tracks(document)
    assert (moves["weights"].min(), moves["weights"].max()) == (0.0, 1.0)
    shown = shown_skins(tmp_path / "sequence.glb", NEUTRAL.vertices)
    assert np.linalg.norm(shown - skins, axis=2).max() < SEQUENCE_BASIS.within_mm
    turns = Rotation.from_quat(moves["rotation"]).as_matrix()
    expected = Rotation.from_rotvec([[0.0, 0.6 * number, 0.0] for number in range(FRAMES)])
    np.testing.assert_allclose(turns, expected.as_matrix(), atol=1e-6)
    assert (np.sum(moves["rotation"][1:] * moves["rotation"][:-1], axis=1) > 0).all()
    np.testing.assert_allclose(moves["translation"][3], [0.005, 0.0, 0.003], atol=1e-7)


def test_a_still_face_keeps_the_motion_of_its_head(tmp_path: Path) -> None:
    animated = AnimatedSkin(NEUTRAL)
    for number in range(FRAMES):
        animated.add(frame(number), NEUTRAL.vertices)
    animated.write(tmp_path / "sequence.glb", 25.0)
    assert validate_glb(tmp_path / "sequence.glb", []) == []
    moves = tracks(pygltflib.GLTF2().load(str(tmp_path / "sequence.glb")))
    assert set(moves) == {"rotation", "translation"}
    np.testing.assert_allclose(moves["translation"][3], [0.005, 0.0, 0.003], atol=1e-7)
