"""The real solver, and its worker, killed in the middle of a simulation."""

from __future__ import annotations

import csv
import io
import itertools
import os
import signal
from dataclasses import replace
from pathlib import Path

import httpx
import numpy as np
import pytest

from myoface.stack import Stack
from service.settings import Settings
from solver.anatomy.template import ShapeBasis
from solver.animation.controls.mixtures import LEVELS, WalkOptions
from solver.animation.controls.pairs import FIRST_WALKS
from solver.jobs import run_job
from solver.jobs.blendshapes import SAVED_EVERY
from solver.model import SubjectModel
from solver.rig import ExpressionFit, Rig
from solver.scans.live_link import ARKIT_NAMES
from tests.service_client import QUICK, ROOT, Studio, eventually, served
from tests.solver.ball import ball_template
from tests.solver.block import head_block
from tests.solver.jobs.test_scenes import recording

SWAY_SECONDS = 20  # enough that it still plays when its solver and then its worker are killed
SWAY_FRAMES = 30 * SWAY_SECONDS + 1
SWAY = {
    "mode": "dynamic",
    "steps_per_frame": 2,
    "duration": SWAY_SECONDS,
    "keys": [{"time": 0}, {"time": 1, "expressions": {"wide": 1}}],
    "forces": [{"kind": "wind", "m_s": [20, 0, -20], "gusts": 0.5}],
}

TAKE = {"recording": {"asset": "take"}}
EXPRESSIONS = ARKIT_NAMES[:24]


@pytest.mark.slow
def test_killed_processes_cost_no_frame_and_the_animation_ends_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The real solver is killed, then the worker: every frame is solved from the one before it."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    settings = Settings(data_dir=tmp_path / "data", **{**QUICK, "max_attempts": 5})
    subject, rig = fitted(settings, tmp_path, head_block((7, 5, 1)))
    with Stack(settings) as stack, httpx.Client(base_url=stack.url, timeout=30) as http:
        studio = Studio(http, stack.key)
        job = studio.submit("simulate", subject, rig_id=rig, options={"scene": SWAY})
        url = f"/v1/jobs/{job}/frames"

        def ready() -> int:
            return int(studio.get(url)["ready"])

        eventually(lambda: ready() >= 10, seconds=240)
        [solver] = studio.solvers(stack)
        os.kill(solver, signal.SIGKILL)
        before = studio.get(f"{url}?limit=10")["frames"]
        # what was ready when it was killed may still be committed: what comes later is new
        eventually(lambda: studio.job(job)["attempt"] == 2, seconds=60)
        kept = ready()
        eventually(lambda: ready() > kept + 5, seconds=120)
        os.kill(stack.pid("long"), signal.SIGKILL)
        done = studio.finished(job, seconds=240)
        assert done["state"] == "succeeded", done
        outcomes = [attempt["outcome"] for attempt in done["attempts"]]
        assert outcomes == ["lost", "lost", "succeeded"]
        frames = studio.get(f"{url}?limit=1000")["frames"]
        assert [frame["frame"] for frame in frames] == list(range(SWAY_FRAMES))
        assert frames[:10] == before
        assert done["result"]["summary"]["frames"] == SWAY_FRAMES
        [arrays] = [each for each in done["result"]["artifacts"] if each["name"] == "animation.npz"]
        content = http.get(f"/v1/artifacts/{arrays['id']}").content
    with np.load(io.BytesIO(content)) as data:
        pieced = data["skin"]
    run_job("simulate", tmp_path / "whole", options={"scene": SWAY}, rig=tmp_path / "rig.npz")
    with np.load(tmp_path / "whole" / "animation.npz") as data:
        assert np.abs(data["skin"][40] - data["skin"][0]).max() > 2.0
        np.testing.assert_allclose(pieced, data["skin"], atol=0.05)


@pytest.mark.slow
def test_killed_processes_cost_no_blendshape_that_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The solver is killed among the blendshapes, then the worker: each goes on with the next."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    settings = Settings(data_dir=tmp_path / "data", **{**QUICK, "max_attempts": 5})
    model = head_block((16, 12, 3))
    template = with_bumps(tmp_path / "template.npz", model)
    subject, rig = fitted(settings, tmp_path, model, template)
    take = recording(tmp_path / "take.csv", [0.0, 1.0]).read_bytes()
    with Stack(settings) as stack, httpx.Client(base_url=stack.url, timeout=30) as http:
        studio = Studio(http, stack.key)
        upload = studio.upload("take.csv", take)
        path = f"/v1/subjects/{subject}/captures"
        asset = studio.post(path, name="take", role="asset", upload_id=upload)["id"]
        how = {"rig_id": rig, "captures": [asset], "options": {"scene": TAKE}}
        job = studio.submit("animate", subject, **how)

        def solved() -> int:
            step = studio.job(job)["progress"] or {"phase": ""}
            return int(step["iteration"]) if step["phase"] == "blendshapes" else 0

        eventually(lambda: solved() > SAVED_EVERY, seconds=240)
        [solver] = studio.solvers(stack)
        os.kill(solver, signal.SIGKILL)
        eventually(lambda: studio.job(job)["attempt"] == 2, seconds=60)
        eventually(lambda: solved() > 2 * SAVED_EVERY, seconds=240)
        os.kill(stack.pid("long"), signal.SIGKILL)
        done = studio.finished(job, seconds=240)
        assert done["state"] == "succeeded", done
        outcomes = [attempt["outcome"] for attempt in done["attempts"]]
        assert outcomes == ["lost", "lost", "succeeded"]
        told = [
            [
                data["iteration"]
                for _, _, data in studio.events(job)
                if data.get("phase") == "blendshapes" and data["attempt"] == attempt
            ]
            for attempt in (1, 2, 3)
        ]
        for before, after in itertools.pairwise(told):
            assert after[0] > before[-1] - before[-1] % SAVED_EVERY >= SAVED_EVERY
        assert told[-1][-1] == done["result"]["summary"]["blendshapes"] == len(EXPRESSIONS)
        names = [each["name"] for each in done["result"]["artifacts"]]
        assert names.count("blendshapes.npz") == 1
        again = studio.finished(studio.submit("animate", subject, **how), seconds=240)
        assert again["result"]["summary"]["blendshapes"] == len(EXPRESSIONS)
        assert "blendshapes" not in {data.get("phase") for *_, data in studio.events(again["id"])}


@pytest.mark.slow
def test_a_killed_solver_costs_no_pair_that_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The solver is killed among the pairs of controls, which later animations find."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    settings = Settings(data_dir=tmp_path / "data", **{**QUICK, "max_attempts": 5})
    model = head_block((7, 5, 1))
    template = with_bumps(tmp_path / "template.npz", model)
    subject, rig = fitted(settings, tmp_path, model, template)
    take = recording(tmp_path / "take.csv", [0.0, 1.0]).read_bytes()
    walks = WalkOptions()
    first = (FIRST_WALKS - 1) * walks.stops + len(LEVELS) * len(EXPRESSIONS)
    with Stack(settings) as stack, httpx.Client(base_url=stack.url, timeout=30) as http:
        studio = Studio(http, stack.key)
        options = {"pairs": first + 8 * walks.stops, "modes": 16}
        job = studio.submit("learn_controls", subject, rig_id=rig, options=options)

        def solved() -> int:
            step = studio.job(job)["progress"] or {"phase": ""}
            return int(step["iteration"]) if step["phase"] == "pairs" else 0

        eventually(lambda: solved() > first + walks.stops, seconds=240)
        [solver] = studio.solvers(stack)
        os.kill(solver, signal.SIGKILL)
        done = studio.finished(job, seconds=240)
        assert done["state"] == "succeeded", done
        assert [attempt["outcome"] for attempt in done["attempts"]] == ["lost", "succeeded"]
        told = [data for *_, data in studio.events(job) if data.get("phase") == "pairs"]
        again = [data["iteration"] for data in told if data["attempt"] == 2]
        assert again[0] > 0.9 * first
        names = [each["name"] for each in done["result"]["artifacts"]]
        assert names.count("control_pairs.npz") == names.count("controls.npz") == 1
        path = f"/v1/subjects/{subject}/captures"
        upload = studio.upload("take.csv", take)
        asset = studio.post(path, name="take", role="asset", upload_id=upload)
        how = {"rig_id": rig, "captures": [asset["id"]], "options": {"scene": TAKE}}
        played = studio.finished(studio.submit("animate", subject, **how), seconds=240)
        assert played["result"]["summary"]["transfer"]["controls"] == "learned"


NECK_SECONDS = 40


@pytest.mark.slow
def test_killed_processes_change_nothing_of_a_neck_s_motion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The solver is killed while the neck moves, then the worker among the frames."""
    pytest.importorskip("mujoco")
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    settings = Settings(data_dir=tmp_path / "data", **{**QUICK, "max_attempts": 5})
    model = head_block((7, 5, 1))
    template = with_bumps(tmp_path / "template.npz", model)
    subject, rig = fitted(settings, tmp_path, model, template)
    file = tmp_path / "take.csv"
    with file.open("w", newline="") as stream:
        rows = csv.writer(stream)
        rows.writerow(["Timecode", *ARKIT_NAMES, "HeadYaw", "HeadPitch", "HeadRoll"])
        for second in range(NECK_SECONDS + 1):
            weights = [0.5 * np.sin(0.3 * second) ** 2] * len(ARKIT_NAMES)
            turned = 0.5 * np.sin(0.9 * second), 0.2 * np.sin(0.5 * second), 0.0
            rows.writerow([f"00:00:{second:02d}:00.000", *weights, *turned])
    scene = {**TAKE, "mode": "dynamic", "neck": {"skin": False}}
    with Stack(settings) as stack, httpx.Client(base_url=stack.url, timeout=30) as http:
        studio = Studio(http, stack.key)
        upload = studio.upload("take.csv", file.read_bytes())
        path = f"/v1/subjects/{subject}/captures"
        asset = studio.post(path, name="take", role="asset", upload_id=upload)["id"]
        how = {"rig_id": rig, "captures": [asset], "options": {"scene": scene}}
        job = studio.submit("animate", subject, **how)
        url = f"/v1/jobs/{job}/frames"

        def phase() -> str:
            return str((studio.job(job)["progress"] or {"phase": ""})["phase"])

        def ready() -> int:
            return int(studio.get(url)["ready"])

        eventually(lambda: phase() == "neck", seconds=240)
        [solver] = studio.solvers(stack)
        os.kill(solver, signal.SIGKILL)
        eventually(lambda: ready() >= 10, seconds=240)
        before = studio.get(f"{url}?limit=10")["frames"]
        os.kill(stack.pid("long"), signal.SIGKILL)
        done = studio.finished(job, seconds=240)
        assert done["state"] == "succeeded", done
        outcomes = [attempt["outcome"] for attempt in done["attempts"]]
        assert outcomes == ["lost", "lost", "succeeded"]
        frames = studio.get(f"{url}?limit=1000")["frames"]
        assert [frame["frame"] for frame in frames] == list(range(NECK_SECONDS + 1))
        assert frames[:10] == before
        files = {each["name"]: each["id"] for each in done["result"]["artifacts"]}
        assert len(files) == len(done["result"]["artifacts"])
        content = http.get(f"/v1/artifacts/{files['animation.npz']}").content
    given = {"options": {"scene": scene}, "captures": {"take": file}, "template": template}
    run_job("animate", tmp_path / "whole", rig=tmp_path / "rig.npz", **given)
    with (
        np.load(io.BytesIO(content)) as pieced,
        np.load(tmp_path / "whole" / "animation.npz") as whole,
    ):
        assert np.ptp(whole["vertebrae"][:, -1, 1]) > 0.5
        for name in ("vertebrae", "neck_activations"):
            np.testing.assert_allclose(pieced[name], whole[name], atol=1e-6)
        np.testing.assert_allclose(pieced["skin"], whole["skin"], atol=0.05)


def with_bumps(path: Path, model: SubjectModel) -> Path:
    """Write a template of a model's skin; its expressions are bumps at random places."""
    rng = np.random.default_rng(0)
    skin = model.skin.vertices
    away = np.linalg.norm(skin - rng.choice(skin, (len(EXPRESSIONS), 1)), axis=2)
    bumps = np.exp(-((away / 40.0) ** 2))[..., None] * rng.normal(0, 6, (len(EXPRESSIONS), 1, 3))
    nobody = np.zeros((0, *skin.shape), np.float32)
    none = np.zeros(0, int)
    replace(
        ball_template(),
        skin=model.skin,
        flesh_faces=np.arange(len(model.skin.faces)),
        face_vertices=model.face,
        attached_cranium=none,
        attached_mandible=none,
        parting=np.zeros(skin.shape),
        shapes=ShapeBasis(nobody, bumps.astype(np.float32), EXPRESSIONS),
    ).save(path)
    return path


def fitted(
    settings: Settings, folder: Path, model: SubjectModel, template: Path | None = None
) -> tuple[str, str]:
    """Put a subject with a model and rig into a service that stands; return their ids."""
    wide = np.array([[0.8, 0.02, 0.0, 1.1, 0.0, 1.1], [0.8, -0.02, 0.0, 1.1, 0.0, 1.1]])
    skin = model.skin.vertices
    error = np.zeros(len(model.skin.vertices))
    fit = ExpressionFit("wide", "train", wide, np.zeros(5), skin, skin, error, 0, 1, 0.0, 0.0)
    model.save(folder / "model.npz")
    Rig(model, model.weights, (fit,)).save(folder / "rig.npz")
    with served(settings) as studio:
        made_with = {}
        if template is not None:
            upload = studio.upload(template.name, template.read_bytes())
            made_with["template_id"] = studio.post("/v1/templates", name="x", upload_id=upload)[
                "id"
            ]
        subject = studio.post("/v1/subjects", name="Alex", **made_with)["id"]
        studio.capture(subject, "neutral", "neutral")
        smile = studio.capture(subject, "smile")
        files = studio.http.app.state.store.files  # type: ignore[attr-defined]

        def stored(*names: str) -> dict[str, str]:
            return {name: files.put(folder / name).sha256 for name in names}

        made = studio.submit("build_model", subject)
        studio.pretend(made, stored("model.npz"))
        fit_job = studio.submit("fit_geometry", subject, captures=[smile])
        studio.pretend(
            fit_job, stored("rig.npz"), rig={"subject_id": subject, "model_job_id": made}
        )
        return subject, str(studio.job(fit_job)["result"]["rig_id"])
