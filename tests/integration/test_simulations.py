"""Simulations through the service: frames while they run, assets, and killed processes."""

from __future__ import annotations

import io
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from myoface.stack import Stack
from service.settings import Settings
from solver.pipeline import simulate
from solver.rig.result import ExpressionFit, save_activations, save_weights
from tests.service_client import QUICK, Studio, eventually, running, served
from tests.unit.solver.block import head_block


@pytest.fixture(scope="module")
def stack_and_studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Stack, Studio]]:
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


SWAY = {
    "mode": "dynamic",
    "steps_per_frame": 2,
    "duration": 3,
    "keys": [{"time": 0}, {"time": 1, "expressions": {"wide": 1}}],
    "forces": [{"kind": "wind", "m_s": [20, 0, -20], "gusts": 0.5}],
}


@pytest.mark.slow
def test_killed_processes_cost_no_frame_and_the_animation_ends_once(tmp_path: Path) -> None:
    """The real solver is killed, then the worker: every frame is solved from the one before it."""
    settings = Settings(data_dir=tmp_path / "data", **{**QUICK, "max_attempts": 5})
    subject, rig = fitted(settings, tmp_path)
    with Stack(settings) as stack, httpx.Client(base_url=stack.url, timeout=30) as http:
        studio = Studio(http, stack.key)
        job = studio.submit("simulate", subject, rig_id=rig, options={"scene": SWAY})
        url = f"/v1/jobs/{job}/frames"

        def ready() -> int:
            return int(studio.get(url)["ready"])

        eventually(lambda: ready() >= 10, seconds=120)
        [solver] = studio.solvers(stack)
        os.kill(solver, signal.SIGKILL)
        before = studio.get(f"{url}?limit=10")["frames"]
        kept = ready()
        eventually(lambda: ready() > kept + 5, seconds=120)
        os.kill(stack.pid("long"), signal.SIGKILL)
        done = studio.finished(job, seconds=240)
        assert done["state"] == "succeeded", done
        outcomes = [attempt["outcome"] for attempt in done["attempts"]]
        assert outcomes == ["lost", "lost", "succeeded"]
        frames = studio.get(f"{url}?limit=1000")["frames"]
        assert [frame["frame"] for frame in frames] == list(range(91))
        assert frames[:10] == before
        assert done["result"]["summary"]["frames"] == 91
        [arrays] = [each for each in done["result"]["artifacts"] if each["name"] == "animation.npz"]
        content = http.get(f"/v1/artifacts/{arrays['id']}").content
    with np.load(io.BytesIO(content)) as data:
        pieced = data["skin"]
    options = {"scene": SWAY}
    names = ("model.npz", "muscle_weights.npz", "activations.npz")
    simulate(*(tmp_path / name for name in names), tmp_path / "whole", options=options)
    with np.load(tmp_path / "whole" / "animation.npz") as data:
        assert np.abs(data["skin"][40] - data["skin"][0]).max() > 2.0
        np.testing.assert_allclose(pieced, data["skin"], atol=0.05)


def fitted(settings: Settings, folder: Path) -> tuple[str, str]:
    """Put a subject with a block's model and rig into a service that stands; return their ids."""
    model = head_block((7, 5, 1))
    wide = np.array([[0.8, 0.02, 0.0, 1.1, 0.0, 1.1], [0.8, -0.02, 0.0, 1.1, 0.0, 1.1]])
    skin, error = model.skin.vertices, np.zeros(len(model.skin.vertices))
    fit = ExpressionFit("wide", "train", wide, np.zeros(5), skin, skin, error, 0, 1, 0.0, 0.0)
    model.save(folder / "model.npz")
    save_weights(folder / "muscle_weights.npz", model.weights, model)
    save_activations(folder / "activations.npz", (fit,), model)
    with served(settings) as studio:
        subject = studio.subject()
        smile = studio.capture(subject, "smile")
        files = studio.http.app.state.store.files  # type: ignore[attr-defined]

        def stored(*names: str) -> dict[str, str]:
            return {name: files.put(folder / name).sha256 for name in names}

        made = studio.submit("build_model", subject)
        studio.pretend(made, stored("model.npz"))
        fit_job = studio.submit("fit_geometry", subject, captures=[smile])
        left = stored("muscle_weights.npz", "activations.npz")
        studio.pretend(fit_job, left, rig={"subject_id": subject, "model_job_id": made})
        return subject, str(studio.job(fit_job)["result"]["rig_id"])
