"""A rig's sliders are made by a job of their own, and are then one of the rig's files."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from tests.service_client import Studio, running


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    with running(tmp_path_factory.mktemp("stack")) as (_, studio):
        yield studio


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
