"""A rig's sliders are made by a job of their own, and are then one of the rig's files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from myoface.stack import Stack
from service.settings import Settings
from service.store import retention
from service.store.database import Store
from service.store.models import Job, Rig
from tests.service_client import Studio, served

RIG = "8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11"


@pytest.fixture(scope="module")
def studio(stack_and_studio: tuple[Stack, Studio]) -> Studio:
    return stack_and_studio[1]


def test_the_newest_preview_is_the_rig_s(studio: Studio) -> None:
    subject, rig = studio.rigged()
    path = f"/v1/rigs/{rig}/artifacts/preview.bin"
    assert studio.http.get(path).status_code == 404
    assert "preview.bin" not in names(studio, rig)

    for seed in (1, 2):
        job = studio.done("build_preview", subject, rig_id=rig, options={"seed": seed})
        assert job["result"]["rig_id"] is None
        assert job["result"]["summary"] == {"controls": 3}
        content = studio.http.get(path).content
        assert json.loads(content[4:]) == [["smile"], {"seed": seed}]
    assert names(studio, rig).count("preview.bin") == 1

    # another rig of the same person has none yet
    grin = studio.capture(subject, "grin")
    other = studio.done("fit_activations", subject, captures=[grin], rig_id=rig)
    assert "preview.bin" not in names(studio, other["result"]["rig_id"])


def test_a_preview_stays_and_goes_with_its_rig(tmp_path: Path) -> None:
    with served(Settings(data_dir=tmp_path)) as studio:
        subject = studio.subject()
        left = {"rig.npz": "a" * 64}
        model, made = (studio.submit("build_model", subject) for _ in range(2))
        studio.pretend(model, {"model.npz": "c" * 64})
        studio.pretend(made, left)
        store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
        with store.write() as session:
            job = session.get(Job, made)
            assert job
            mine = {"tenant_id": job.tenant_id, "subject_id": subject, "job_id": made}
            session.add(Rig(id=RIG, model_job_id=model, expressions=[], summary={}, **mine))
        preview = studio.submit("build_preview", subject, rig_id=RIG)
        studio.pretend(preview, {"preview.bin": "d" * 64})
        settings: Settings = studio.http.app.state.settings  # type: ignore[attr-defined]
        retention.enforce(store, settings.model_copy(update={"retain_jobs": 0}))
        assert "preview.bin" in names(studio, RIG)
        retention.enforce(store, settings.model_copy(update={"retain_rigs": 0}))
        assert studio.http.get(f"/v1/rigs/{RIG}").status_code == 404
        assert studio.http.get(f"/v1/jobs/{preview}").status_code == 404


def test_a_preview_is_of_a_rig_and_nothing_else(studio: Studio) -> None:
    subject, rig = studio.rigged()
    smile = studio.get(f"/v1/subjects/{subject}/captures")["items"][0]["id"]
    for more, code in (
        ({}, "job.missing"),
        ({"rig_id": rig, "captures": [smile]}, "job.unexpected"),
        ({"rig_id": rig, "options": {"max_seconds": 1}}, "job.options"),
    ):
        job = {"kind": "build_preview", "subject_id": subject, **more}
        answer = studio.http.post("/v1/jobs", json=job)
        assert (answer.status_code, answer.json()["code"]) == (422, code)


def names(studio: Studio, rig: str) -> list[str]:
    return [artifact["name"] for artifact in studio.get(f"/v1/rigs/{rig}")["artifacts"]]
