"""A studio's rig of a block of flesh: its shapes by muscles, its files, and what a report says."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.errors import InputError
from solver.jobs import blendshapes, build_studio_rig, run_job
from solver.registration.texture import Texture
from solver.rig.frames.read_back import split_glb
from tests.solver.jobs.test_learned_controls import MODEL, NAMES, rig, template

__all__ = ["rig", "template"]  # fixtures
pytestmark = pytest.mark.long


@pytest.fixture
def built(template: SimpleNamespace, monkeypatch: pytest.MonkeyPatch) -> None:
    for job in (blendshapes, build_studio_rig):
        monkeypatch.setattr(job, "read_template", lambda _: template)


def image(folder: Path, coordinates: TextureCoordinates) -> Path:
    """Write the colours that a registration left, with what it says of them."""
    path = folder / "texture.png"
    pixels = np.full((8, 8, 3), 90, np.uint8)
    texture = Texture(pixels, pixels[:, :, 0], coordinates, {"ssim": 0.93, "coverage": 0.9})
    texture.write(path, folder / "confidence.png")
    return path


@pytest.mark.usefixtures("built")
def test_shapes_are_the_muscles_and_have_arkit_s_names(
    rig: Path, template: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = run_job("build_studio_rig", tmp_path, options={"driven_by": "joints"}, rig=rig)
    told = json.loads((tmp_path / "studio.json").read_text())
    assert set(told["shapes"]) == set(NAMES)
    assert told["not_settled_in_contact"] == []
    assert [each["code"] for each in told["notices"]] == ["studio.no_texture"]
    assert told["shapes_worst_mm"] < 0.3
    assert set(told["shapes"]["jawOpen"]["joints"]) == {"jaw"}
    assert "joints" not in told["shapes"]["mouthSmileLeft"]
    names = {file.name for file in files}
    assert {
        "studio.glb",
        "studio_half.glb",
        "studio_quarter.glb",
        "studio.png",
        "studio.usdc",
    } <= names
    assert {"blendshapes.npz", "expression_basis.npz"} <= names
    document, _ = split_glb(tmp_path / "studio.glb")
    targets = {name for mesh in document["meshes"] for name in mesh["extras"]["targetNames"]}
    assert set(NAMES) == targets
    # blendshapes of an earlier job are taken as they are
    assert told["texture"] == {}
    again = tmp_path / "again"
    given = tmp_path / "blendshapes.npz"
    corners = np.arange(MODEL.skin.faces.size, dtype=np.int32).reshape(-1, 3)
    places = np.random.default_rng(5).random((corners.size, 2)).astype(np.float32)
    coordinates = TextureCoordinates(places, corners)
    monkeypatch.setattr(template, "texture", coordinates, raising=False)
    texture = image(tmp_path, coordinates)
    run_job("build_studio_rig", again, rig=rig, blendshapes=given, texture=texture)
    assert not (again / "expression_basis.npz").exists()
    shapes = json.loads((again / "studio.json").read_text())
    assert shapes["driven_by"] == "shapes"
    assert shapes["texture"] == {"ssim": 0.93, "coverage": 0.9}
    assert (again / "studio.png").read_bytes() != (tmp_path / "studio.png").read_bytes()
    assert "joints" not in shapes["shapes"]["jawOpen"]


def test_a_template_without_expressions_is_told(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = SimpleNamespace(shapes=None)
    monkeypatch.setattr(build_studio_rig, "read_template", lambda _: plain)
    with pytest.raises(InputError, match="no expressions") as caught:
        run_job("build_studio_rig", tmp_path, rig=rig)
    assert caught.value.code == "blendshapes.none"
