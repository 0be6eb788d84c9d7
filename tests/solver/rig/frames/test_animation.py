"""What a simulation leaves: arrays, pictures and a film that say the same."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from solver.animation import track
from solver.errors import InputError
from solver.model import SubjectModel
from solver.rig.frames import animation
from solver.rig.frames.animation import MotionRecord, write_animation
from solver.scene.places import SceneObject
from solver.storage import read_arrays
from solver.surface import Floats, Surface
from solver.templates.builtin.build import builtin_expression
from tests.solver.block import block_model

FRAMES = 4
FPS = 25.0


def head_model() -> SubjectModel:
    """Return a model of which only the skin counts, a whole head's."""
    skin = builtin_expression({})
    front = np.flatnonzero(skin.vertices[:, 2] > 60.0)
    return replace(block_model(), skin=skin, face=front)


def frame(number: int) -> MotionRecord:
    turn = np.array([0.0, 0.05 * number, 0.0, 0.0, 2.0 * number, 0.0])
    return MotionRecord(
        frame=number,
        time=2.0 + number / FPS,
        activations=np.full((2, 6), float(number)),
        jaw=np.zeros(5),
        head=turn,
        eyes=np.zeros((2, 3)),
        moved=np.zeros((0, 3)),
        penetration_mm=0.01 * number,
        behind_teeth=0,
        inverted=0,
        iterations=3,
        halvings=0,
        residual=1e-6,
        seconds=0.5,
    )


def opening(amount: float) -> Floats:
    return builtin_expression({"jawOpen": amount}).vertices


@pytest.mark.slow
def test_all_files_show_the_same(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    model = head_model()
    skins = np.array([opening(number / FRAMES) for number in range(FRAMES)], np.float32)
    ball = trimesh.creation.icosphere(radius=25.0)
    faces = np.asarray(ball.faces, np.int64)

    shape = Surface(np.asarray(ball.vertices), faces)
    path = track([2.0, 3.0], np.array([[0, 0, 0, x, 0, 160.0] for x in (0.0, 60.0)]), "key")

    files = write_animation(
        tmp_path,
        model,
        [frame(number) for number in range(FRAMES)],
        skins,
        title="Opening",
        report={"inverted": 0},
        vertices=model.face,
        objects=[SceneObject("ball", shape, path)],
        video=True,
    )
    ends = ("json", "glb", "npz", "png", "mp4")
    assert [path.name for path in files] == [f"animation.{end}" for end in ends]
    report = json.loads(files[0].read_text())
    assert report["inverted"] == 0
    assert report["glb"]["bytes"] == files[1].stat().st_size
    assert report["glb"]["max_error_mm"] < 0.2

    arrays = read_arrays(files[2])
    np.testing.assert_allclose(arrays["time"], 2.0 + np.arange(FRAMES) / FPS)
    assert arrays["activations"].shape == (FRAMES, 2, 6)
    np.testing.assert_array_equal(arrays["vertices"], model.face)
    turn = Rotation.from_rotvec(frame(3).head[:3])
    placed = turn.apply(skins[3, model.face]) + frame(3).head[3:]
    np.testing.assert_allclose(arrays["skin"][3], placed, atol=1e-4)

    with Image.open(files[3]) as sheet:
        assert sheet.width > 1000
    with av.open(str(files[4])) as film:
        pictures = [each.to_ndarray(format="rgb24") for each in film.decode(video=0)]
        assert film.streams.video[0].average_rate == FPS
    assert len(pictures) == FRAMES
    changes = [np.abs(after.astype(int) - pictures[0]).mean() for after in pictures]
    assert changes[-1] > changes[1] > 0.2  # the head turns, the mouth opens


def test_a_film_has_the_times_of_its_frames(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    times = [0.0, 1 / 30, 2 / 30, 2.0, 2.0 + 1 / 30]
    plates = [np.full((64, 96, 3), 0.2 * number) for number in range(len(times))]
    animation.write_video(tmp_path / "film.mp4", plates, (96, 64), 30.0, times)
    with av.open(str(tmp_path / "film.mp4")) as film:
        shown = [each.time for each in film.decode(video=0)]
    np.testing.assert_allclose(np.array(shown) - shown[0], times, atol=1e-3)


def test_a_film_without_its_library_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(animation, "find_spec", lambda _name: None)
    with pytest.raises(InputError, match="pip install") as caught:
        animation.check_video()
    assert caught.value.code == "options.video"
