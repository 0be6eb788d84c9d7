"""Takes and scenes become films on the page, by the real solver: no file goes up twice.

Each step leaves a picture in the test's folder, so that a person can see what the page showed.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from myoface.stack import Stack
from service.settings import Settings
from service.store.models import DEFAULT_TENANT
from solver.fitting.face import Face
from solver.neck.builtin import builtin_neck
from solver.rig.exporters import write_rig
from solver.rig.report.certificate import certify
from tests.browser.rig_place import drawing_browser, put_rig
from tests.fixtures import small_rig
from tests.osim_file import osim_text
from tests.service_client import Studio, served
from tests.solver.scans.markers.made_take import LABELS, made_positions
from tests.take_files import c3d_bytes

pytestmark = [pytest.mark.slow, pytest.mark.long]

Page = Any
FRAMES = slice(100, 220, 20)  # from rest into the first expressions
SOLVED_MS = 300_000
# has the places that the rig view draws last in window.posed, with their frame
HEAR = """document.querySelector(".rig").addEventListener("posed", ({ detail }) => {
  const frame = Number(document.querySelector("input[aria-label=Frame]").value);
  window.posed = { frame, places: Array.from(detail.places) };
})"""


class Walk:
    """A person's way over the page: faults in its console, requests, a picture of each step."""

    def __init__(self, page: Page, url: str, key: str, pictures: Path) -> None:
        self.page = page
        self.faults: list[str] = []
        self.asked: list[str] = []
        self._base = url
        self._key = key
        self._pictures = pictures
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.on("console", lambda each: each.type == "error" and self.faults.append(each.text))
        page.on("request", lambda each: self.asked.append(f"{each.method} {each.url}"))

    def go(self, path: str) -> None:
        self.page.goto(f"{self._base}{path}#key={self._key}")

    def look(self, step: str) -> None:
        number = len(list(self._pictures.glob("*.png")))
        self.page.screenshot(path=self._pictures / f"{number}-{step}.png", full_page=True)

    def submit(self) -> None:
        self.page.get_by_role("dialog").get_by_role("button", name="Submit").click()

    @property
    def job(self) -> str:
        return str(self.page.evaluate("location.pathname")).rsplit("/", 1)[1]


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Stack, str, str]]:
    """A running service with a person's rig; gives the ids of both."""
    folder = tmp_path_factory.mktemp("rig")
    settings = Settings(data_dir=tmp_path_factory.mktemp("stack"), port=0)
    fitted = small_rig()
    files = write_rig(fitted, certify(Face(fitted.model), fitted, {}), folder)
    summary = json.loads((folder / "report.json").read_text())
    with served(settings) as studio:
        store = studio.http.app.state.store.of(DEFAULT_TENANT)  # type: ignore[attr-defined]
        subject, rig = put_rig(store, "Ada", files, summary)
    with Stack(settings) as stack:
        yield stack, subject, rig


@pytest.fixture
def walk(stack: tuple[Stack, str, str], tmp_path: Path) -> Iterator[Walk]:
    with drawing_browser() as chromium:
        context = chromium.new_context(viewport={"width": 1280, "height": 800})
        context.set_default_timeout(SOLVED_MS)
        walk = Walk(context.new_page(), stack[0].url, stack[0].key, tmp_path)
        yield walk
        context.close()
    assert walk.faults == []


def test_a_take_is_checked_bound_fitted_played_and_exported(
    stack: tuple[Stack, str, str], walk: Walk, tmp_path: Path
) -> None:
    _, subject, _ = stack
    page = walk.page
    _upload(walk, subject, tmp_path / "talk.c3d")
    sent = len(walk.asked)

    walk.go(f"/subjects/{subject}")
    page.get_by_role("button", name="Check talk").click()
    walk.look("ask-for-the-check")
    walk.submit()
    page.get_by_role("row", name="talk").get_by_role("link", name="Usable").click()
    page.get_by_role("button", name="Fit the take").wait_for()
    walk.look("check")
    check = walk.job

    page.get_by_role("link", name="Place the markers").click()
    page.get_by_label("Label UpperLip", exact=True).wait_for()
    walk.look("bound")
    page.get_by_role("link", name="The check").click()

    page.get_by_role("button", name="Fit the take").click()
    dialog = page.get_by_role("dialog")
    assert dialog.get_by_label("markers.json of Check markers", exact=False).is_checked()
    # the template's expressions are of another skin than the small person's
    dialog.get_by_label("Prior", exact=True).select_option(label="scans")
    walk.look("ask-for-the-fit")
    walk.submit()
    page.get_by_role("button", name="Play it in a scene").wait_for()
    page.get_by_role("link", name="markers.json").wait_for()  # what it reads
    walk.look("fit")
    fit = walk.job

    page.get_by_role("button", name="Play it in a scene").click()
    assert dialog.get_by_role("checkbox", name="sequence.npz of", exact=False).is_checked()
    scene = dialog.get_by_label("Scene", exact=True)
    scene.fill('{"performance": {"asset": "sequence"}, "fps": 3}')
    walk.look("ask-for-the-film")
    walk.submit()
    page.get_by_role("img", name="Moments of the animation").wait_for()
    page.get_by_role("button", name="Download animation.glb").wait_for()
    walk.look("film")
    film = walk.job

    walk.go(f"/jobs/{fit}")
    page.get_by_role("link", name="Simulate,").wait_for()  # by which it is read
    walk.look("handed-on")

    walk.go(f"/subjects/{subject}")
    page.get_by_role("button", name="Delete talk").click()
    page.get_by_text("Jobs that have read it stay").wait_for()
    walk.look("before-a-deletion")
    page.get_by_role("dialog").get_by_role("button", name="Back").click()
    page.get_by_role("button", name="Export rig").click()
    walk.submit()
    page.get_by_role("button", name="Download rig.glb").wait_for()
    walk.look("export")

    uploads = [each for each in walk.asked[sent:] if "/v1/uploads" in each or "/captures" in each]
    assert not [each for each in uploads if not each.startswith("GET")]
    _is_handed_on(stack, check=check, fit=fit, film=film, export=walk.job)


def test_a_head_on_a_chosen_neck_plays_on_the_rig(
    stack: tuple[Stack, str, str], walk: Walk
) -> None:
    """The form writes the neck into the scene; the rig view shows what was simulated."""
    pytest.importorskip("mujoco")
    running, subject, _ = stack
    with httpx.Client(base_url=running.url, timeout=30) as http:
        studio = Studio(http, running.key)
        upload = studio.upload("spine.osim", osim_text(builtin_neck()).encode())
        path = f"/v1/subjects/{subject}/captures"
        file = studio.post(path, name="spine", role="asset", upload_id=upload)["id"]
    page = walk.page
    walk.go(f"/subjects/{subject}")
    page.get_by_role("button", name="Simulate", exact=True).click()
    dialog = page.get_by_role("dialog")
    scene = dialog.get_by_label("Scene", exact=True)
    necks = dialog.get_by_label("Neck", exact=True)
    turn = {"time": 1, "rotation_deg": [-10, 40, 0]}
    asked = {"fps": 4, "keys": [{"time": 0}, {"time": 1}], "head": [{"time": 0}, turn]}
    scene.fill(json.dumps(asked))
    assert necks.input_value() == ""
    necks.select_option(label="built-in")
    assert json.loads(scene.input_value()) == {**asked, "neck": {}}
    scene.fill(json.dumps({**asked, "neck": {"coupling": False}}))
    assert necks.input_value() == "built-in"
    necks.select_option(label="spine, an OpenSim file")
    asked["neck"] = {"asset": "spine", "coupling": False}
    assert json.loads(scene.input_value()) == asked
    scene.fill("{")
    assert necks.is_disabled()
    scene.fill(json.dumps(asked))
    walk.look("ask-for-a-neck")
    walk.submit()
    page.get_by_role("img", name="Head and neck with bones and muscles").wait_for()
    walk.look("neck")
    with httpx.Client(base_url=running.url, timeout=30) as http:
        studio = Studio(http, running.key)
        job = studio.job(walk.job)
        assert (job["captures"], job["options"]["scene"]) == ([file], asked)
        [left] = [each for each in job["result"]["artifacts"] if each["name"] == "animation.npz"]
        content = http.get(f"/v1/artifacts/{left['id']}").content
    with np.load(io.BytesIO(content)) as data:
        skins, vertices, head = data["skin"], data["vertices"], data["head"]
    assert np.degrees(np.linalg.norm(head[-1, :3])) > 30.0

    page.get_by_role("link", name="Play it on the rig").click()
    page.get_by_text("as its neck carries it").wait_for()
    page.evaluate(HEAR)
    for frame in (4, 2):
        page.get_by_label("Frame", exact=True).fill(str(frame))
        page.get_by_text(f"{frame + 1} of 5, {frame / 4:.2f} s", exact=True).wait_for()
        page.wait_for_function("frame => window.posed?.frame === frame", arg=frame)
        shown = np.array(page.evaluate("window.posed.places")).reshape(-1, 3)
        assert np.linalg.norm(shown[vertices] - skins[frame], axis=1).max() < 0.3
        walk.look(f"frame-{frame}")


def _upload(walk: Walk, subject: str, file: Path) -> None:
    file.write_bytes(c3d_bytes(made_positions(FRAMES.stop)[FRAMES], list(LABELS), rate=3.0))
    walk.go(f"/upload?subject={subject}")
    walk.page.set_input_files("#files", str(file))
    walk.page.get_by_role("button", name="Upload 1").click()
    walk.page.get_by_text("A take of markers: it is checked").wait_for()
    walk.look("uploaded")


def _is_handed_on(stack: tuple[Stack, str, str], **jobs: str) -> None:
    """Check what each job read of the one before, and what it left."""
    running, _, rig = stack
    with httpx.Client(base_url=running.url, timeout=30) as http:
        studio = Studio(http, running.key)
        check, fit, film, export = (studio.job(jobs[name]) for name in jobs)
    frames = len(range(FRAMES.start, FRAMES.stop, FRAMES.step))
    for job in (check, fit, film, export):
        assert (job["state"], job["rig_id"]) == ("succeeded", rig)
    assert [each["job"] for each in fit["from_jobs"]] == [check["id"]]
    assert [each["job"] for each in film["from_jobs"]] == [fit["id"]]
    assert fit["result"]["summary"]["fitted"] == film["result"]["summary"]["frames"] == frames
    assert fit["result"]["summary"]["mean_mm"] < 3.0
    formats = {each["name"]: each["format"] for each in fit["result"]["artifacts"]}
    assert (formats["sequence.npz"], formats["markers.json"]) == (2, 1)
    left = {each["name"]: each["size"] for each in film["result"]["artifacts"]}
    assert left["animation.glb"] > 0
    assert [each["name"] for each in export["result"]["artifacts"]] == ["export.json", "rig.glb"]
