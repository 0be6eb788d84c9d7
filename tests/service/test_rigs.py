"""A rig's files: what jobs read of it, and which are there for one release more."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from service.settings import Settings
from service.store.models import Job
from tests.service_client import Studio, served

FILES_OF_0_1 = ("muscle_weights.npz", "activations.npz")
OLD = {"weights": "muscle_weights.npz", "rig": "activations.npz", "model": "model.npz"}


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Studio]:
    with served(Settings(data_dir=tmp_path_factory.mktemp("rigs"))) as studio:
        yield studio


def rig_of(studio: Studio, *names: str) -> tuple[str, str]:
    """Return a subject and a rig whose fit left files of these names."""
    subject = studio.subject()
    smile = studio.capture(subject, "smile")
    files = studio.http.app.state.store.files  # type: ignore[attr-defined]
    content = files.put(Path(__file__)).sha256
    model = studio.submit("build_model", subject)
    studio.pretend(model, {"model.npz": content})
    fit = studio.submit("fit_geometry", subject, captures=[smile])
    left = dict.fromkeys(names, content)
    studio.pretend(fit, left, rig={"subject_id": subject, "model_job_id": model})
    return subject, str(studio.job(fit)["result"]["rig_id"])


def inputs_of(studio: Studio, job_id: str) -> dict[str, str]:
    with studio.http.app.state.store.write() as session:  # type: ignore[attr-defined]
        job = session.get(Job, job_id)
        assert job
        return {each["role"]: each["filename"] for each in job.inputs}


@pytest.mark.parametrize("kind", ["build_preview", "export_rig"])
@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (("rig.npz", *FILES_OF_0_1), {"rig": "rig.npz"}),
        (FILES_OF_0_1, OLD),
        ((*FILES_OF_0_1, "report.json"), {**OLD, "report": "report.json"}),
    ],
    ids=["one file", "0.1", "0.1 with its report"],
)
def test_jobs_read_the_one_file_or_those_of_the_release_before(
    studio: Studio, kind: str, files: tuple[str, ...], expected: dict[str, str]
) -> None:
    subject, rig = rig_of(studio, *files)
    assert inputs_of(studio, studio.submit(kind, subject, rig_id=rig)) == expected


def test_parts_are_deprecated_where_the_whole_is(studio: Studio) -> None:
    _, rig = rig_of(studio, "rig.npz", *FILES_OF_0_1)
    _, old = rig_of(studio, *FILES_OF_0_1)
    path = f"/v1/rigs/{rig}/artifacts"
    assert "Deprecation" not in studio.http.head(f"{path}/rig.npz").headers
    for name in FILES_OF_0_1:
        part = studio.http.head(f"{path}/{name}")
        assert part.status_code == 200
        assert part.headers["Deprecation"].startswith("@")
        assert part.headers["Link"] == f'<{path}/rig.npz>; rel="successor-version"'
        assert "Deprecation" not in studio.http.head(f"/v1/rigs/{old}/artifacts/{name}").headers


def test_an_export_names_the_formats(studio: Studio) -> None:
    subject, rig = rig_of(studio, "rig.npz")
    job = {"kind": "export_rig", "subject_id": subject, "rig_id": rig}
    answer = studio.http.post("/v1/jobs", json={**job, "options": {"format": "fbx"}})
    assert answer.status_code == 422
    assert answer.json()["detail"].startswith("options.format: 'fbx' is not one of 'csv', 'glb'")
