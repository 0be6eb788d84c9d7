"""Simulations through the service: frames while they run, assets, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from myoface.stack import Stack
from tests.servers.production import Production
from tests.service_client import Studio, eventually, running


@pytest.fixture(scope="module")
def stack_and_studio(
    parts: Production | None, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Stack, Studio]]:
    with running(tmp_path_factory.mktemp("stack")) as both:
        yield both


@pytest.fixture(scope="module")
def studio(stack_and_studio: tuple[Stack, Studio]) -> Studio:
    return stack_and_studio[1]


@pytest.fixture(scope="module")
def rigged(studio: Studio) -> tuple[str, str]:
    return studio.rigged()


def asset(studio: Studio, subject: str, name: str, filename: str) -> str:
    upload = studio.upload(filename, b"asset")
    path = f"/v1/subjects/{subject}/captures"
    return str(studio.post(path, name=name, role="asset", upload_id=upload)["id"])


def test_frames_and_their_picture_are_there_while_it_runs(
    studio: Studio, rigged: tuple[str, str]
) -> None:
    subject, rig = rigged
    glass = asset(studio, subject, "glass", "glass of a window.stl")
    scene = {"fps": 10, "duration": 60, "damping": 0.1}
    job = studio.submit("simulate", subject, rig_id=rig, captures=[glass], options={"scene": scene})
    url = f"/v1/jobs/{job}/frames"
    eventually(lambda: studio.get(url)["ready"] >= 6)
    page = studio.get(f"{url}?start=1&limit=2")
    assert [frame["frame"] for frame in page["frames"]] == [1, 2]
    assert "x" not in page["frames"][0]
    assert page["frames"][0]["penetration_mm"] == 0.1
    picture = studio.http.get(f"{url}/picture")
    assert picture.headers["content-type"] == "image/jpeg"
    assert picture.content.startswith(b"JPEG of ")
    studio.post(f"/v1/jobs/{job}/cancel")
    studio.until(job, "canceled", seconds=5)
    assert studio.get(url)["ready"] >= 6


def test_what_a_scene_leaves_and_what_it_reads(studio: Studio, rigged: tuple[str, str]) -> None:
    subject, rig = rigged
    take = asset(studio, subject, "take", "take of Alex.csv")
    scene = {"fps": 2, "duration": 1}
    done = studio.done("simulate", subject, rig_id=rig, captures=[take], options={"scene": scene})
    assert done["result"]["summary"]["assets"] == {"take": "take of Alex.csv"}
    kinds = {file["name"]: file["media_type"] for file in done["result"]["artifacts"]}
    assert kinds["animation.mp4"] == "video/mp4"
    fitted = asset(studio, subject, "fitted", "sequence.npz")
    options = {"scene": {**scene, "performance": {"asset": "fitted", "gain": 2}}}
    done = studio.done("simulate", subject, rig_id=rig, captures=[fitted], options=options)
    assert done["result"]["summary"]["assets"] == {"fitted": "sequence.npz"}
    # a simulation after a calibration of the rig gets its muscles
    assert done["result"]["summary"]["fibre_muscles"] is None
    studio.done("fit_fibres", subject, rig_id=rig)
    done = studio.done("simulate", subject, rig_id=rig, captures=[fitted], options=options)
    assert done["result"]["summary"]["fibre_muscles"] == "calibrated"
    options = {"scene": {"recording": {"asset": "take"}}}
    found = [
        studio.done("animate", subject, rig_id=rig, captures=[take], options=options)["result"][
            "summary"
        ]["blendshapes"]
        for _ in range(2)
    ]
    # the second animation of a rig gets what the first one solved
    assert found == [None, "solved"]


def test_scenes_and_assets_that_are_none_are_refused(
    studio: Studio, rigged: tuple[str, str]
) -> None:
    subject, rig = rigged
    smile = studio.capture(subject, "smile-for-nothing")
    stone = asset(studio, subject, "stone", "stone.obj")
    scene = {"keys": [{"time": -1}]}
    body = {"kind": "simulate", "subject_id": subject, "rig_id": rig}
    for wrong, code in (
        ({"options": {"scene": scene}}, "job.options"),
        ({"options": {}}, "job.options"),
        ({"options": {"scene": {}}, "captures": [smile]}, "capture.not_an_asset"),
        ({"kind": "fit_activations", "captures": [stone]}, "capture.is_asset"),
    ):
        answer = studio.http.post("/v1/jobs", json=body | wrong)
        assert (answer.status_code, answer.json()["code"]) == (422, code)
    answer = studio.http.post("/v1/jobs", json=body | {"options": {"scene": scene}})
    assert answer.json()["errors"][0]["where"] == "options.scene.keys[0].time"
    upload = studio.upload("stone.txt", b"asset")
    path = f"/v1/subjects/{subject}/captures"
    answer = studio.http.post(path, json={"name": "x", "role": "asset", "upload_id": upload})
    assert answer.json()["code"] == "capture.format"
    answer = studio.http.get(f"/v1/jobs/{studio.submit('build_model', subject)}/frames/picture")
    assert answer.json()["code"] == "job.no_frames"
