"""Frames of a performance on their way through the service."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from myoface.client import Client
from myoface.stack import Stack
from service.jobs.schemas import FrameView
from service.queue.table import Claim
from service.store.database import Store
from service.store.files import FolderFiles
from service.store.models import DEFAULT_TENANT
from solver.mechanics.flesh import IDENTITY
from solver.rig import Rig
from solver.rig.frames import SequenceFrame, write_chunk
from tests.service_client import Studio, eventually
from tests.solver.block import block_model
from worker.attempt import AttemptFolder
from worker.solve import solve


@pytest.fixture(scope="module")
def studio(stack_and_studio: tuple[Stack, Studio]) -> Studio:
    return stack_and_studio[1]


@pytest.fixture(scope="module")
def rigged(studio: Studio) -> tuple[str, str]:
    return studio.rigged()


def submit(studio: Studio, rigged: tuple[str, str], name: str, **orders: Any) -> str:
    subject, rig = rigged
    take = studio.performance(subject, name, **orders)
    return studio.submit("fit_sequence", subject, captures=[take], rig_id=rig)


def numbers(studio: Studio, job: str, start: int = 0, limit: int = 100) -> list[int]:
    page = studio.get(f"/v1/jobs/{job}/frames?start={start}&limit={limit}")
    assert page["next"] == start + len(page["frames"])
    return [frame["frame"] for frame in page["frames"]]


def test_frames_come_while_the_job_runs_and_stay_when_it_is_canceled(
    studio: Studio, rigged: tuple[str, str]
) -> None:
    job = submit(studio, rigged, "long", frames=1000, seconds=0.1)
    eventually(lambda: len(numbers(studio, job)) >= 6)
    assert studio.job(job)["state"] == "running"
    assert numbers(studio, job, 1, 4) == [1, 2, 3, 4]
    studio.post(f"/v1/jobs/{job}/cancel", reason="enough seen")
    studio.until(job, "canceled", seconds=5)
    kept = numbers(studio, job, limit=1000)
    assert kept == list(range(len(kept)))
    assert len(kept) >= 6
    assert numbers(studio, job, len(kept)) == []


def test_a_killed_solver_goes_on_after_its_last_frame(
    stack_and_studio: tuple[Stack, Studio], studio: Studio, rigged: tuple[str, str]
) -> None:
    job = submit(studio, rigged, "killed", frames=8, fault="killed")
    with Client(stack_and_studio[0].url, studio.key) as client:
        frames = list(client.frames(job, follow=True))
    done = studio.finished(job)
    assert [attempt["outcome"] for attempt in done["attempts"]] == ["lost", "succeeded"]
    assert done["result"]["summary"] == {"frames": 8}
    assert [file["name"] for file in done["result"]["artifacts"]] == [
        "sequence.json",
        "sequence.npz",
    ]
    assert [frame.frame for frame in frames] == list(range(8))
    # The stand-in writes down how many frames it found: the second attempt found the first's.
    assert [frame.iterations for frame in frames] == [0, 0, 0, 0, 4, 4, 4, 4]


def test_a_scan_is_no_performance(studio: Studio, rigged: tuple[str, str]) -> None:
    subject, rig = rigged
    laugh = studio.capture(subject, "laugh")
    take = studio.performance(subject, "take")
    for captures, code in (
        ([laugh], "capture.not_a_performance"),
        ([take, take], "job.one_capture"),
    ):
        body = {"kind": "fit_sequence", "subject_id": subject, "rig_id": rig, "captures": captures}
        answer = studio.http.post("/v1/jobs", json=body)
        assert (answer.status_code, answer.json()["code"]) == (422, code)


def test_the_real_solver_goes_on_in_an_attempt_s_folder(tmp_path: Path) -> None:
    """What the worker hands over is what the pipeline takes, and its frames what the API shows."""
    model = block_model()
    database = Store(
        f"sqlite:///{tmp_path / 'myoface.db'}", tmp_path / "files", "redis://127.0.0.1:1"
    )
    store = database.files
    Rig(model, model.weights, ()).save(tmp_path / "rig.npz")
    still = model.skin.vertices[model.face]
    np.save(tmp_path / "take.npy", [still, still + 0.1, still, still])
    inputs = [
        {"role": name, "name": name, "filename": file, "sha256": store.put(tmp_path / file).sha256}
        for name, file in (("rig", "rig.npz"), ("performance", "take.npy"))
    ]
    before = SequenceFrame(
        frame=0,
        status="fitted",
        activations=np.tile(IDENTITY, (2, 1)),
        jaw=np.zeros(5),
        head=np.zeros(6),
        mean_mm=0.0,
        p95_mm=0.0,
        max_mm=0.0,
        coverage=1.0,
        inverted=0,
        iterations=1,
        seconds=0.0,
    )
    ready = write_chunk(tmp_path / "before", 0, [before], {})
    frames = {ready.name: store.put(ready).sha256}
    claim = Claim(
        "job", DEFAULT_TENANT, 2, "fit_sequence", "ada", inputs, {"step": 2}, None, None, frames, {}
    )
    folder = AttemptFolder(tmp_path, claim)
    folder.stage(database)
    result = solve(folder.path, lambda _step: None)
    assert (result["summary"]["frames"], result["summary"]["fitted"]) == (2, 2)
    folder.measure()
    (row,) = folder.new_frames(store)
    assert (row["first"], row["last"]) == (1, 1)
    assert isinstance(store, FolderFiles)
    left = json.loads(store.path(row["sha256"]).read_bytes())
    assert [FrameView.model_validate(each).frame for each in left["frames"]] == [2]
    assert {artifact.name for artifact in folder.store(store, {})} == {
        "activations.csv",
        "contractions.bin",
        "sequence.glb",
        "sequence.json",
        "sequence.npz",
        "sequence.png",
        "sequence.usdc",
    }


def test_only_a_sequence_has_frames(studio: Studio) -> None:
    job = studio.submit("build_model", studio.subject())
    answer = studio.http.get(f"/v1/jobs/{job}/frames")
    assert (answer.status_code, answer.json()["code"]) == (409, "job.no_frames")
