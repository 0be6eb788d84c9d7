"""The eyes' image and an eyeball's places in it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from solver.rig.frames.read_back import split_glb
from solver.rig.studio.eyes import EYE_COLOURS, EyeImageOptions, eye_image, eye_places
from solver.rig.studio.glb import write_glb
from solver.rig.studio.light_rig import LightRig
from solver.rig.studio.shapes import StudioShapes
from tests.fixtures import small_model


def test_the_iris_lies_where_an_eyeball_looks() -> None:
    options = EyeImageOptions()
    turns = np.linspace(0.0, np.pi, 19)
    across = np.radians(np.arange(0.0, 360.0, 30.0))
    turn, way = (each.ravel() for each in np.meshgrid(turns, across))
    sides = np.stack([np.cos(way), np.sin(way)])
    points = 12.0 * np.column_stack([*(np.sin(turn) * sides), np.cos(turn)])
    places = eye_places(points + np.array([30.0, 40.0, 70.0]))
    assert places.min() >= 0.0
    assert places.max() <= 1.0
    image = np.asarray(Image.open(io.BytesIO(eye_image())), np.float64)
    columns = (places[:, 0] * (options.pixels - 1)).round().astype(int)
    rows = ((1.0 - places[:, 1]) * (options.pixels - 1)).round().astype(int)
    bright = image[rows, columns].mean(axis=1)
    assert bright[turn < np.radians(10.0)].max() < 60.0  # the pupil
    assert np.all((bright > 60.0) & (bright < 160.0), where=turn == turns[2])  # 20 degrees
    assert bright[turn > np.radians(35.0)].min() > 200.0  # the sclera, and the back
    # as it is seen: up is up, the subject's left at the image's right
    left = eye_places(points)[(turn == turns[1]) & (way == 0.0)]
    assert left[0, 0] > 0.5


def test_a_rig_s_eyes_wear_the_image(tmp_path: Path) -> None:
    model = small_model()
    still = np.zeros((1, *model.skin.vertices.shape))
    none = StudioShapes(("jawOpen",), still, np.zeros((1, 5)), np.zeros((1, 2, 3)), np.zeros(1))
    path = tmp_path / "studio.glb"
    write_glb(LightRig.of(model, none, "shapes"), path)
    document, _ = split_glb(path)
    worn = {
        document["materials"][primitive["material"]]["name"]: "TEXCOORD_0"
        in primitive["attributes"]
        for mesh in document["meshes"]
        for primitive in mesh["primitives"]
    }
    assert worn["eyes"]
    assert not worn["skin"]
    assert [f"{image['name']}.png" for image in document["images"]] == [EYE_COLOURS]
    eyes = next(each for each in document["materials"] if each["name"] == "eyes")
    assert eyes["pbrMetallicRoughness"]["baseColorTexture"]["index"] == 0
