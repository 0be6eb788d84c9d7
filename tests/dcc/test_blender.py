"""Blender reads rigs, sequences and animations: names, sizes, axes, shapes, how they move.

Blender's Python module lives in an environment of its own, which ``scripts/blender-venv`` makes;
``MYOFACE_BLENDER_PYTHON`` names another interpreter that has it.
"""

from __future__ import annotations

import json
import os
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from solver.mechanics.boundary import move_jaw
from solver.rig import ExpressionFit, Rig
from solver.rig.exporters import glb
from solver.rig.frames import SequenceFrame
from solver.rig.frames.animation_gltf import (
    SEQUENCE_BASIS,
    AnimatedSkin,
    AnimationOptions,
    write_animation_glb,
)
from solver.rig.frames.gltf import Solid
from solver.surface import Floats, Surface, vertex_normals
from solver.templates.builtin.build import builtin_expression
from tests.solver.block import block_model

ROOT = Path(__file__).parents[2]
EXPRESSIONS = {
    "smile": {"mouthSmileLeft": 1.0, "mouthSmileRight": 1.0},
    "surprise": {"browInnerUp": 1.0, "jawOpen": 0.5},
    "ah": {"jawOpen": 1.0},
}
NAMES = list(EXPRESSIONS)
FPS = 30
UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Blender's axes by glTF's: y up becomes z up, the face looks along -y."""


@pytest.fixture(scope="session")
def blender() -> Path:
    python = Path(os.environ.get("MYOFACE_BLENDER_PYTHON", ROOT / ".venv-blender/bin/python"))
    if not python.exists():
        pytest.skip("Blender's Python module is not there; scripts/blender-venv makes it ready")
    return python


@dataclass(frozen=True)
class Scene:
    """What Blender says of the scene that ``docs/examples/blender_import.py`` made of a GLB."""

    known: dict[str, Any]
    arrays: dict[str, np.ndarray]

    def mm(self, name: str) -> Floats:
        """Return the vertices of an array in mm, y up."""
        return self.arrays[name].astype(np.float64) @ UP * 1e3


def imported(blender: Path, glb: Path, frames: list[float]) -> Scene:
    """Import a GLB with the example, and read the scene that it saves."""
    blend = glb.with_suffix(".blend")
    found = glb.with_suffix(".npz")
    commands = (
        ["docs/examples/blender_import.py", str(glb), str(blend), "--fps", str(FPS)],
        ["tests/dcc/blender_scene.py", str(blend), str(found), *map(str, frames)],
    )
    for command in commands:
        child = subprocess.run(
            [blender, *command], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
        )
        assert child.returncode == 0, child.stdout + child.stderr
    with np.load(found) as file:
        arrays = dict(file)
    return Scene(json.loads(str(arrays.pop("known"))), arrays)


@pytest.fixture(scope="module")
def rig() -> Rig:
    """Return a rig of the built-in face; only its skin counts here."""
    skin = builtin_expression({})
    model = replace(block_model(), skin=skin, face=np.arange(1000))
    error = np.full(len(skin.vertices), np.nan)
    error[model.face] = 0.5
    rest = np.zeros((model.muscle_count, 6)), np.zeros(5)
    fits = []
    for name, weights in EXPRESSIONS.items():
        shape = builtin_expression(weights).vertices
        fits.append(ExpressionFit(name, "train", *rest, shape, shape, error, 0, 1, 1.0, 0.1))
    return Rig(model, model.weights, tuple(fits), {})


@pytest.fixture(scope="module")
def scene(blender: Path, rig: Rig, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("blender") / "rig.glb"
    glb.write(rig, path)
    held = 1.6 * FPS + 0.8 * FPS
    half_way = 0.3 * FPS
    return imported(blender, path, [0.0, half_way, held])


def test_the_face_is_there_by_name_and_in_one_piece(rig: Rig, scene: Scene) -> None:
    assert scene.known["objects"] == ["face"]
    assert scene.known["keys"] == ["Basis", *NAMES]
    assert scene.known["materials"] == ["skin", "mouth", "teeth", "eyes"]
    assert scene.known["repaired"] is False
    assert len(scene.arrays["corners"]) == rig.model.skin.faces.size


def test_size_axes_and_vertex_order_are_the_scan_s(rig: Rig, scene: Scene) -> None:
    neutral = rig.model.skin.vertices
    np.testing.assert_allclose(scene.mm("rest"), neutral, atol=1e-4)
    metres = scene.arrays["rest"]
    assert 0.2 < np.ptp(metres[:, 2]) < 0.4  # a head, upright
    tip = metres[neutral[:, 2].argmax()]
    assert tip[1] == metres[:, 1].min()  # it looks along -y


@pytest.mark.parametrize("name", NAMES)
def test_shape_keys_move_the_right_vertices(rig: Rig, scene: Scene, name: str) -> None:
    fit = next(fit for fit in rig.expressions if fit.name == name)
    np.testing.assert_allclose(scene.mm(f"key_{name}"), fit.skin, atol=2e-3)


def test_normals_are_smooth_and_outward(rig: Rig, scene: Scene) -> None:
    expected = vertex_normals(rig.model.skin)[scene.arrays["corners"]]
    found = scene.arrays["normals"] @ UP
    off = np.degrees(np.arccos(np.clip(np.sum(found * expected, axis=1), -1.0, 1.0)))
    assert np.percentile(off, 99.9) < 1.0


def test_the_animation_shows_one_expression_after_the_other(rig: Rig, scene: Scene) -> None:
    whole = 1.6 * len(NAMES) * FPS
    assert scene.known["actions"]["expressions"] == pytest.approx([0.0, whole], abs=1e-3)
    assert scene.known["range"] == [0, round(whole)]
    assert scene.known["markers"] == {"smile": 18, "surprise": 66, "ah": 114}
    neutral = rig.model.skin.vertices
    smile, surprise = (fit.skin for fit in rig.expressions[:2])
    np.testing.assert_allclose(scene.mm("frame_0"), neutral, atol=1e-4)
    np.testing.assert_allclose(scene.mm("frame_1"), (neutral + smile) / 2, atol=2e-3)
    np.testing.assert_allclose(scene.mm("frame_2"), surprise, atol=2e-3)


def test_the_distance_to_the_scans_comes_along(rig: Rig, scene: Scene) -> None:
    expected = np.zeros(len(rig.model.skin.vertices))
    expected[rig.model.face] = 0.5
    np.testing.assert_allclose(scene.arrays["error_mm"], expected, atol=1e-6)


def test_a_sequence_moves_as_it_was_fitted(blender: Path, tmp_path: Path) -> None:
    """Blender holds a shape key's value between 0 and 1: no weight of the file may be beyond."""
    neutral = builtin_expression({})
    away = builtin_expression(EXPRESSIONS["smile"]).vertices - neutral.vertices
    lift = np.sin(0.03 * neutral.vertices)
    skins = [
        neutral.vertices + np.cos(0.9 * number) * away + 3.0 * np.sin(1.7 * number) * lift
        for number in range(8)
    ]
    animated = AnimatedSkin(neutral)
    for number, skin in enumerate(skins):
        animated.add(_frame(number), skin)
    path = tmp_path / "sequence.glb"
    animated.write(path, float(FPS))
    scene = imported(blender, path, [float(number) for number in range(8)])
    assert scene.known["range"] == [0, 7]
    for number, skin in enumerate(skins):
        expected = _placed(skin, number)
        off = np.linalg.norm(scene.mm(f"frame_{number}") - expected, axis=1).max()
        assert off < SEQUENCE_BASIS.within_mm + 0.01, f"frame {number}"


def test_a_take_in_usd_plays_by_the_file_s_frames(blender: Path, rig: Rig, tmp_path: Path) -> None:
    usd = pytest.importorskip("solver.rig.exporters.usd", exc_type=ModuleNotFoundError)
    neutral = rig.model.skin
    model = rig.model
    corners = 10.0 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    bone = Surface(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    animated = AnimatedSkin(neutral)
    away = rig.expressions[0].skin - neutral.vertices
    shown = range(101, 107)
    for number in shown:
        jaw = 0.1 * (number - 100) * np.array([1.0, 0.2, 1.0, 2.0, 3.0])
        skin = neutral.vertices + np.cos(0.9 * number) * away
        animated.add(replace(_frame(number), jaw=jaw), skin)
    path = tmp_path / "sequence.usdc"
    found = tmp_path / "found.npz"
    usd.write_sequence(path, replace(model, bones={"mandible": bone}), animated, float(FPS))
    command = [blender, "tests/dcc/blender_usd.py", path, found, *map(str, shown)]
    child = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert child.returncode == 0, child.stdout + child.stderr
    with np.load(found) as arrays:
        assert arrays["range"].tolist() == [101, 106]
        for frame in animated.frames:
            skin = neutral.vertices + np.cos(0.9 * frame.frame) * away
            jaw = move_jaw(model.jaw, corners, frame.jaw)
            for name, places in (("Skin", skin), ("mandible", jaw)):
                off = 1e3 * arrays[f"{name}_{frame.frame}"] @ UP - _placed(places, frame.frame)
                assert np.linalg.norm(off, axis=1).max() < 0.02, (name, frame.frame)


def test_an_animation_is_made_of_few_shapes(blender: Path, tmp_path: Path) -> None:
    """Of whole numbers, sparse, on fewer keys than frames: Blender shows all frames."""
    neutral = builtin_expression({})
    away = builtin_expression(EXPRESSIONS["smile"]).vertices - neutral.vertices
    opened = builtin_expression(EXPRESSIONS["ah"]).vertices - neutral.vertices
    skins = np.array(
        [
            neutral.vertices + np.cos(0.3 * number) * away + min(0.1 * number, 0.6) * opened
            for number in range(12)
        ],
        np.float32,
    )
    heads = np.array([_frame(number).head for number in range(12)])
    path = tmp_path / "animation.glb"
    pane = Surface(1000.0 * np.eye(3), np.array([[0, 1, 2]]))
    solids = [Solid("glass", pane, heads)]
    written = write_animation_glb(path, neutral, skins, heads, np.arange(12) / FPS, solids)
    assert written.max_error_mm < 0.2
    scene = imported(blender, path, [float(number) for number in range(12)])
    assert set(scene.known["objects"]) == {"face", "glass"}
    assert scene.known["range"] == [0, 11]
    for number, skin in enumerate(skins):
        off = np.linalg.norm(scene.mm(f"frame_{number}") - _placed(skin, number), axis=1).max()
        assert off < written.max_error_mm + AnimationOptions().keys_mm + 0.01, f"frame {number}"


def _frame(number: int) -> SequenceFrame:
    head = np.array([0.0, 0.1 * number, 0.0, 5.0 * number, 0.0, 2.0])
    figures = {"mean_mm": 0.1, "p95_mm": 0.2, "max_mm": 0.3, "coverage": 1.0, "seconds": 0.1}
    pose = {"activations": np.zeros((1, 6)), "jaw": np.zeros(5), "head": head}
    return SequenceFrame(frame=number, status="fitted", inverted=0, iterations=1, **pose, **figures)


def _placed(skin: Floats, number: int) -> Floats:
    """Return a skin (v, 3) with the head's motion of :func:`_frame`."""
    head = _frame(number).head
    return skin @ Rotation.from_rotvec(head[:3]).as_matrix().T + head[3:]
