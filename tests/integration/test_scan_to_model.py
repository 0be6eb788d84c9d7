"""A scanner's own file, uploaded over HTTP, becomes a model: real API, broker, workers, solver."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from PIL import Image

from myoface.client import Client
from myoface.resources import Job
from myoface.stack import Stack
from service.settings import Settings
from tests.fixtures import data_folder

VERDICT_S = 60
PICTURES = ("check.png", "distance.png", "anatomy.png", "tets.png")


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("stack"), port=0)
    with Stack(settings) as stack, Client(stack.url) as client:
        yield client


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scan", "landmarks"),
    [
        ("menpo3d/james.obj", "menpo3d/james.ljson"),
        ("meshmonk/DemoFace_10K.obj", None),
    ],
)
def test_a_raw_scan_becomes_a_model(
    client: Client, scan: str, landmarks: str | None, tmp_path: Path
) -> None:
    path = data_folder("scans", scan)
    subject = client.create_subject(path.stem)
    neutral = client.add_capture(
        subject.id,
        path,
        role="neutral",
        registered=False,
        landmarks=landmarks and data_folder("scans", landmarks),
    )
    check = client.run("check_scan", subject.id, captures=[neutral.id])
    assert seconds(check) <= VERDICT_S
    assert summary(check)["verdict"] in ("good", "usable"), summary(check)
    registration = client.run("register_scan", subject.id, captures=[neutral.id])
    model = client.run("build_model", subject.id)
    assert summary(model)["inverted"] == 0
    assert summary(model)["muscles"] >= 40

    for job in (check, registration, model):
        assert job.result is not None
        for artifact in job.result.artifacts:
            client.download(artifact, tmp_path / artifact.name)
    for name in PICTURES:
        with Image.open(tmp_path / name) as picture:
            assert min(picture.size) >= 200, name


def seconds(job: Job) -> float:
    assert job.created_at
    assert job.finished_at
    return (job.finished_at - job.created_at).total_seconds()


def summary(job: Job) -> dict:
    assert job.result is not None
    assert job.result.summary is not None
    return job.result.summary
