"""A studio's rig on its job's page, in Chromium: it wears its images and goes where sliders say."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from solver.anatomy.texture_coordinates import TextureCoordinates
from solver.jobs.build_studio_rig import tell_shapes
from solver.rig.studio.glb import write_glb
from solver.rig.studio.light_rig import LightRig
from solver.rig.studio.shapes import StudioShapes
from solver.rig.studio.skeleton import Skeleton
from solver.rig.studio.skin_texture import SkinTexture
from solver.storage import write_json
from tests.browser.rig_place import SECONDS, Place, drawing_browser, put_job, put_rig
from tests.fixtures import small_model

pytestmark = pytest.mark.slow

NAMES = ("jawOpen", "mouthSmileLeft")
TURN = np.array([0.3, 0.0, 0.0, 0.0, -2.0])  # of the jaw, rad and mm
WRINKLES = "studio_wrinkles_1.png"
Page = Any


@pytest.fixture
def page(place: Place, tmp_path: Path) -> Iterator[Page]:
    """The page of a job that left a rig; an error in its console fails the test."""
    subject, rig = put_rig(place.store, "Dora", [], {})
    told = _write_studio_rig(tmp_path)
    job = put_job(place.store, subject, "build_studio_rig", tmp_path.iterdir(), told, rig)
    faults: list[str] = []
    with drawing_browser() as chromium:
        page = chromium.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(SECONDS * 1000)
        page.on("pageerror", lambda error: faults.append(str(error)))
        page.on("console", lambda each: faults.append(each.text) if each.type == "error" else None)
        page.goto(f"{place.url}/jobs/{job}#key={place.key}")
        page.get_by_role("img", name="The studio's rig").wait_for()
        yield page
    assert faults == []


def _write_studio_rig(folder: Path) -> dict[str, Any]:
    """Write the files of a job for a face with images; return what its studio.json says."""
    model = small_model()
    skin = model.skin
    flat = skin.vertices[:, :2]
    size = np.ptp(flat, axis=0)
    places = ((flat - flat.min(axis=0)) / size).astype(np.float32)
    coordinates = TextureCoordinates(places, skin.faces.astype(np.int32))
    bulge = np.zeros_like(skin.vertices)
    bulge[:, 2] = 0.3 * size[0] * np.exp(-8.0 * ((places - 0.5) ** 2).sum(axis=1))
    jaw = np.array([TURN, np.zeros(5)])
    skeleton = Skeleton.of(model)
    turned = skeleton.motions(skeleton.twists(model, TURN, np.zeros((2, 3))))
    opened = skeleton.skin(skin.vertices, turned) - skin.vertices
    shapes = StudioShapes(
        NAMES, np.array([opened, bulge]), jaw, np.zeros((2, 2, 3)), np.zeros(len(NAMES))
    )
    light = LightRig.of(model, shapes, "joints")
    stripes = np.tile(np.array([[90], [165]], np.uint8).repeat(8, axis=0), (8, 128))
    rest = np.full_like(stripes, 255)
    half = np.full_like(stripes, 128)
    images = {
        "colours": np.dstack([rest, stripes, half]),
        "normals": np.dstack([stripes, half, rest]),
        WRINKLES: np.dstack([half, stripes, rest, rest]),
    }
    png = {}
    for name, pixels in images.items():
        content = io.BytesIO()
        Image.fromarray(pixels).save(content, "PNG")
        png[name] = content.getvalue()
    (folder / WRINKLES).write_bytes(png[WRINKLES])
    texture = SkinTexture(coordinates, png["colours"], png["normals"])
    write_glb(light, folder / "studio.glb", texture)
    told = {
        **tell_shapes(light, shapes),
        "wrinkles": {"grin": {"file": WRINKLES, "driven_by": {"mouthSmileLeft": 0.5}}},
    }
    write_json(folder / "studio.json", told)
    return told


def test_a_rig_wears_its_images_and_goes_where_sliders_say(page: Page) -> None:
    stage = page.locator(".stage-room")
    seen = [_picture(stage)]

    def changed() -> None:
        """Something else is drawn than ever before."""
        page.wait_for_timeout(200)
        now = _picture(stage)
        assert all(np.abs(now - before).max() > 20 for before in seen)
        seen.append(now)

    page.get_by_label("jawOpen", exact=True).first.fill("1")  # a joint
    changed()
    page.get_by_role("button", name="mouthSmileLeft", exact=True).click()
    assert page.get_by_label("jawOpen", exact=True).first.input_value() == "0"
    page.get_by_text("Wrinkles: grin 1.00").wait_for()
    changed()
    for layer in ("Wrinkles", "Normal map", "Colours"):
        page.get_by_label(layer, exact=True).uncheck()
        changed()
    page.get_by_role("button", name="Neutral").click()
    page.get_by_label("Colours", exact=True).check()
    page.get_by_label("Normal map", exact=True).check()
    page.wait_for_timeout(200)
    assert np.abs(_picture(stage) - seen[0]).max() < 20


def _picture(stage: Any) -> np.ndarray:
    """Return what is shown (h, w, 3)."""
    image = Image.open(io.BytesIO(stage.screenshot()))
    return np.asarray(image.convert("RGB"), np.int16)
