"""Which weights of a light rig bring the wrinkles of an expression."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from PIL import Image

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.errors import InputError
from solver.registration.skin_images import made_for
from solver.rig import Rig
from solver.rig.studio.shapes import StudioShapes
from solver.rig.studio.wrinkle_maps import drive_wrinkles, read_wrinkle_images
from tests.solver.block import head_block

MODEL = head_block()
NAMES = ("browInnerUp", "jawOpen", "mouthSmileLeft")


@pytest.fixture
def shapes() -> StudioShapes:
    motions = np.random.default_rng(2).normal(size=(3, *MODEL.skin.vertices.shape))
    return StudioShapes(NAMES, motions, np.zeros((3, 5)), np.zeros((3, 2, 3)), np.zeros(3))


def test_a_map_is_driven_by_its_shape_or_by_what_its_expression_is_made_of(
    shapes: StudioShapes, tmp_path: Path
) -> None:
    skin = MODEL.skin
    corners = np.arange(skin.faces.size, dtype=np.int32).reshape(-1, 3)
    places = np.random.default_rng(3).random((skin.faces.size, 2)).astype(np.float32)
    coordinates = TextureCoordinates(places, corners)
    path = tmp_path / "wrinkle_normals.png"
    Image.fromarray(np.zeros((8, 8, 4), np.uint8)).save(path, pnginfo=made_for(coordinates))
    moved = skin.vertices + 0.8 * shapes.motions[0] + 0.4 * shapes.motions[2]
    grin = cast(Any, SimpleNamespace(name="grin", skin=moved))
    rig = Rig(MODEL, MODEL.weights, (grin,))
    files = {"jawOpen": path, "grin": path}
    images = read_wrinkle_images(files, rig, NAMES, coordinates)
    alone, mixed = drive_wrinkles(images, rig, shapes)
    assert alone.driven_by == {"jawOpen": 1.0}
    assert mixed.driven_by == pytest.approx({"browInnerUp": 0.8, "mouthSmileLeft": 0.4}, abs=0.02)
    assert alone.file != mixed.file
    with pytest.raises(InputError) as caught:
        read_wrinkle_images({"frown": path}, rig, NAMES, coordinates)
    assert caught.value.code == "wrinkles.unknown"
    assert "grin" in str(caught.value)
