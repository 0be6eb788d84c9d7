"""Markers in Chromium: placed on a person, saved as a set, and a fitted take of them played."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from solver.scans.markers.places.marker_set import MarkerSet
from solver.surface import Floats
from tests.browser.rig_place import SECONDS, Place, drawing_browser, until
from tests.service_client import Studio

pytestmark = pytest.mark.slow

Page = Any
BOXES = """(selector) => [...document.querySelectorAll(selector)].map((each) => {
  const { left, top, right, bottom } = each.getBoundingClientRect();
  return [left, top, right, bottom];
})"""


@pytest.fixture
def look(place: Place) -> Iterator[Callable[[str], Page]]:
    """Open a path of the page; an error in its console fails the test."""
    faults: list[str] = []
    with drawing_browser() as chromium:
        context = chromium.new_context(viewport={"width": 1280, "height": 800})
        context.set_default_timeout(SECONDS * 1000)

        def open_page(path: str) -> Page:
            page = context.new_page()
            page.on("pageerror", lambda error: faults.append(str(error)))
            page.on("console", lambda each: each.type == "error" and faults.append(each.text))
            page.goto(f"{place.url}{path}#key={place.key}")
            return page

        yield open_page
        context.close()
    assert faults == []


def test_a_marker_is_dragged_renamed_and_the_set_saved(
    place: Place, look: Callable[[str], Page]
) -> None:
    page = look(f"/markers/{place.check}")
    page.get_by_label("Label M00").wait_for()
    page.evaluate(
        "document.querySelector('.rig').addEventListener('placed', (event) => {"
        "  window.placed = event.detail; })"
    )
    page.get_by_label("Label M05").focus()
    page.keyboard.press("Alt+ArrowRight")
    until(lambda: page.evaluate("window.placed?.chosen") == 5)
    by_keys = np.array(page.evaluate("Array.from(window.placed.places)")).reshape(-1, 3)
    places = _places(place)
    assert 0.3 < np.linalg.norm(by_keys[5] - places[5]) < 2.0
    np.testing.assert_allclose(
        np.delete(by_keys, 5, axis=0), np.delete(places, 5, axis=0), atol=1e-3
    )

    x, y = _on_canvas(page, place.sample.neutral.vertices, by_keys[2])
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(1, 6):
        page.mouse.move(x + 4 * step, y - 2 * step)
    page.mouse.up()
    assert page.evaluate("window.placed.chosen") == 2
    dragged = np.array(page.evaluate("Array.from(window.placed.places)")).reshape(-1, 3)
    assert 3.0 < np.linalg.norm(dragged[2] - places[2]) < 40.0

    page.get_by_label("Label M07").fill("Chin")
    page.get_by_label("Label M08").fill("M07")  # free now
    page.get_by_label("Label M09").fill("Chin")
    page.get_by_label("Label M10").focus()
    page.get_by_text("Another marker is called Chin.").wait_for()
    page.get_by_label("Label M09").fill("M09")
    page.get_by_label("What M11 rides on").select_option("head")
    sent: list[bytes] = []
    page.on("request", lambda each: each.method == "PATCH" and sent.append(each.post_data_buffer))
    page.get_by_role("button", name="Save the marker set").click()
    page.get_by_text("The marker set is saved as").wait_for()
    page.get_by_text("Marker set", exact=True).wait_for()
    found = json.loads(sent[0])
    assert MarkerSet.from_document(found).labels[7] == "Chin"
    entries = {each["label"]: each for each in found["markers"]}
    assert {"Chin", "M07", "M09"} < set(entries)
    assert entries["M11"]["part"] == "head"
    np.testing.assert_allclose(entries["M11"]["at"], places[11], atol=1e-3)
    skin = place.sample.neutral.vertices
    at = entries["M02"]["at"]
    foot = np.array(at["weights"]) @ skin[at["vertices"]]
    assert np.linalg.norm(foot - dragged[2]) == pytest.approx(2.0, abs=1e-2)
    assert found["session"] == place.markers.to_document()["session"]


def test_names_stand_beside_dots_and_twins_move_together(
    place: Place, look: Callable[[str], Page]
) -> None:
    page = look(f"/markers/{place.check}")
    page.get_by_label("Label M00").wait_for()
    names = page.locator(".marker-names text")
    until(lambda: names.count() > 8)
    boxes = page.evaluate(BOXES, ".marker-names text")
    for number, (left, top, right, bottom) in enumerate(boxes):
        for other in boxes[:number]:
            assert (
                left >= other[2]
                or other[0] >= right
                or top >= other[3] - 2
                or (other[1] >= bottom - 2)
            )
    foremost = place.markers.labels[int(_places(place)[:, 2].argmax())]
    page.get_by_label(f"Label {foremost}").hover()  # however many are about it
    until(lambda: foremost in names.all_text_contents())

    page.evaluate(
        "document.querySelector('.rig').addEventListener('placed', (event) => {"
        "  window.placed = event.detail; })"
    )
    page.get_by_label("both sides together").check()
    page.get_by_label("Label LCheek").focus()
    page.keyboard.press("Alt+ArrowUp")
    left = place.markers.labels.index("LCheek")
    right = place.markers.labels.index("RCheek")
    until(lambda: page.evaluate("window.placed?.chosen") == left)
    found = np.array(page.evaluate("Array.from(window.placed.places)")).reshape(-1, 3)
    assert np.linalg.norm(found[left] - _places(place)[left]) > 0.3
    assert np.linalg.norm(found[right] - found[left] * [-1.0, 1.0, 1.0]) < 6.0
    others = [left, right]
    np.testing.assert_allclose(
        np.delete(found, others, axis=0), np.delete(_places(place), others, axis=0), atol=1e-3
    )
    page.get_by_label("names", exact=True).uncheck()
    until(lambda: names.count() <= 2)  # what is chosen keeps its own, and its twin


def test_a_take_of_markers_plays_with_its_lanes(place: Place, look: Callable[[str], Page]) -> None:
    page = look(f"/rigs/{place.first}?take={place.marked}:4")
    lanes = page.get_by_role("list", name="Labels")
    rows = lanes.get_by_role("listitem")
    rows.nth(23).wait_for()
    assert rows.nth(0).inner_text().split()[0] == "M03"  # the worst first
    assert "gap in 4 frames" in rows.nth(0).inner_text()
    page.get_by_text("20 of 24 markers count; gap: M03; outlier: M05; swap: M07, M08.").wait_for()
    held = page.get_by_role("list", name="Held muscles").get_by_role("listitem")
    assert "Risorius l" in held.nth(0).inner_text()
    page.get_by_text("2 muscles are never held.").wait_for()
    box = rows.nth(0).locator("canvas").bounding_box()
    page.mouse.click(box["x"] + 0.8 * box["width"], box["y"] + box["height"] / 2)
    until(lambda: f"{place.marked}:7" in page.evaluate("location.search"))
    page.get_by_text("24 of 24 markers count; 1 muscle held.").wait_for()


def test_a_check_leads_to_the_places_of_its_markers(
    place: Place, look: Callable[[str], Page]
) -> None:
    page = look(f"/jobs/{place.check}")
    page.get_by_role("link", name="Place the markers").click()
    page.get_by_text("24 markers").wait_for()


def test_another_actor_s_take_is_fitted_by_the_form(
    place: Place, look: Callable[[str], Page]
) -> None:
    with httpx.Client(base_url=place.url) as http:
        studio = Studio(http, place.key)
        subject_id = studio.get(f"/v1/rigs/{place.second}")["subject_id"]
        upload = {"upload_id": studio.upload("take_9.csv", b"Frame,M00"), "name": "take_9"}
        path = f"/v1/subjects/{subject_id}/captures"
        take = studio.post(path, role="markers", **upload)["id"]

        page = look(f"/subjects/{subject_id}")
        page.get_by_role("button", name="Fit take_9").click()
        page.get_by_label("Neutral").fill("-3")
        page.get_by_label("Actor").check()
        page.get_by_text("the take is another person's than the rig").wait_for()
        page.get_by_role("button", name="Submit").click()
        page.wait_for_url("**/jobs/*")
        first = page.evaluate("location.pathname")
        job = studio.get(f"/v1{first}")
        assert (job["rig_id"], job["captures"]) == (place.second, [take])
        assert job["options"] == {"neutral": -3, "actor": True}

        studio.post(f"/v1{first}/cancel")
        page.get_by_role("button", name="Run again").click()
        page.get_by_label("Neutral").fill("")
        page.get_by_label("Actor").uncheck()
        page.get_by_role("dialog").get_by_role("button", name="Run again").click()
        page.wait_for_url(lambda url: "/jobs/" in url and first not in url)
        job = studio.get(f"/v1{page.evaluate('location.pathname')}")
        assert job["options"] == {"neutral": None, "actor": False}


def _places(place: Place) -> Floats:
    markers = place.markers
    skin = place.sample.neutral.vertices
    corners = skin[markers.vertices]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.einsum("kc,kcd->kd", markers.weights, corners) + 2.0 * normals


def _on_canvas(page: Page, neutral: Floats, point: Floats) -> tuple[float, float]:
    """Return where a point of the face is on the screen, seen from the front."""
    low = neutral.min(axis=0)
    high = neutral.max(axis=0)
    canvas = page.locator("canvas.stage").bounding_box()
    centre = (low + high) / 2
    half = max(high[1] - low[1], 0.6 * (high[0] - low[0])) / 2
    tangent = np.tan(np.radians(13.0))
    distance = 1.04 * half / tangent + (high[2] - low[2]) / 2
    off = point - centre
    scale = canvas["height"] / 2 / tangent / (distance - off[2])
    wide = max(high[0] - low[0], 0.8 * (high[2] - low[2])) / (2 * half)
    scale *= min(1.0, canvas["width"] / canvas["height"] / wide)
    x = canvas["x"] + canvas["width"] / 2 + scale * off[0]
    return x, canvas["y"] + canvas["height"] / 2 - scale * off[1]
