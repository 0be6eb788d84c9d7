"""The real solver, and its worker, killed in the middle of a simulation."""

from __future__ import annotations

import io
import os
import signal
from pathlib import Path

import httpx
import numpy as np
import pytest

from myoface.stack import Stack
from service.settings import Settings
from solver.pipeline import PersonFiles, simulate
from solver.rig.result import ExpressionFit, save_activations, save_weights
from tests.service_client import QUICK, ROOT, Studio, eventually, served
from tests.unit.solver.block import head_block

SWAY = {
    "mode": "dynamic",
    "steps_per_frame": 2,
    "duration": 3,
    "keys": [{"time": 0}, {"time": 1, "expressions": {"wide": 1}}],
    "forces": [{"kind": "wind", "m_s": [20, 0, -20], "gusts": 0.5}],
}


@pytest.mark.slow
def test_killed_processes_cost_no_frame_and_the_animation_ends_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The real solver is killed, then the worker: every frame is solved from the one before it."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    settings = Settings(data_dir=tmp_path / "data", **{**QUICK, "max_attempts": 5})
    subject, rig = fitted(settings, tmp_path)
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
    person = PersonFiles(tmp_path / "model.npz", tmp_path / "muscle_weights.npz", tmp_path)
    simulate(person, tmp_path / "whole", options=options)
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
