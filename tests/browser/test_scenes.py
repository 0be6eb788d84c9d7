"""Scenes on the page: given as JSON, watched while they are played."""

import json
from collections.abc import Callable
from typing import Any

import pytest

from tests.service_client import Studio

pytestmark = pytest.mark.slow

Show = Callable[..., Any]


def test_a_scene_is_played_and_its_newest_frame_is_seen(show: Show, studio: Studio) -> None:
    subject, _ = studio.rigged()
    page = show(f"/subjects/{subject}", refusals=True)
    page.get_by_role("button", name="Simulate").click()
    dialog = page.get_by_role("dialog")
    box = dialog.get_by_label("Scene")
    box.fill('{"fps": "fast"}')
    dialog.get_by_role("button", name="Submit").click()
    dialog.get_by_text("options.scene.fps").wait_for()
    scene = {"duration": 12, "fps": 10, "damping": 0.2, "keys": [{"time": 0}]}
    box.fill(json.dumps(scene))
    dialog.get_by_role("button", name="Submit").click()

    newest = page.get_by_role("img", name="The newest frame")
    newest.wait_for()
    assert newest.evaluate("image => image.decode().then(() => image.naturalWidth)") == 480
    page.get_by_role("img", name="Moments of the animation").wait_for(timeout=60_000)
    assert newest.is_hidden()
    assert json.loads(page.get_by_label("JSON").inner_text()) == scene
    page.get_by_text("0.12 mm").wait_for()
