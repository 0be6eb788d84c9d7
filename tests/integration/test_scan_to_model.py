"""A scanner's own file, uploaded over HTTP, becomes a model: real API, broker, workers, solver."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from myoface.client import Client
from myoface.resources import Capture, Job
from myoface.roles import Role
from myoface.stack import Stack
from service.settings import Settings
from solver.surface import Surface
from solver.templates.builtin.build import builtin_capture_set
from tests.fixtures import data_folder
from tests.servers.production import Production

VERDICT_S = 60
PICTURES = ("check.png", "distance.png", "anatomy.png", "tets.png")


@pytest.fixture(scope="module")
def client(parts: Production | None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("stack"), port=0)
    with Stack(settings) as stack, Client(stack.url, stack.key) as client:
        yield client


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scan", "landmarks"),
    [("menpo3d/james.obj", "menpo3d/james.ljson"), ("meshmonk/DemoFace_10K.obj", None)],
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


@pytest.mark.slow
def test_raw_neutral_and_smile_become_a_rig(client: Client, tmp_path: Path) -> None:
    scans = builtin_capture_set()
    subject = client.create_subject("Ada")

    def captured(name: str, surface: Surface, role: Role) -> Capture:
        path = tmp_path / f"{name}.obj"
        as_scanned(surface).export(path)
        return client.add_capture(subject.id, path, role=role, registered=False)

    neutral = captured("neutral", scans.neutral, "neutral")
    smile = captured("smile", scans.train["smile"], "expression")
    for capture in (neutral, smile):
        check = client.run("check_scan", subject.id, captures=[capture.id])
        assert summary(check)["verdict"] in ("good", "usable"), summary(check)
        registration = client.run("register_scan", subject.id, captures=[capture.id])
        assert summary(registration)["mean_mm"] < 0.3
    client.run("build_model", subject.id, options={"edge_mm": 16.0})
    rig = client.run("fit_geometry", subject.id, captures=[smile.id], options={"rounds": 2})
    assert summary(rig)["inverted"] == 0
    assert summary(rig)["train_mean_mm"] < 1.0


def as_scanned(surface: Surface) -> trimesh.Trimesh:
    """Return a surface in cm, with z up and -y forward, and in no template's order."""
    order = np.random.default_rng(0).permutation(len(surface.vertices))
    number = np.argsort(order)
    x, y, z = surface.vertices[order].T / 10.0
    return trimesh.Trimesh(np.column_stack([x, -z, y]), number[surface.faces], process=False)


def seconds(job: Job) -> float:
    assert job.created_at
    assert job.finished_at
    return (job.finished_at - job.created_at).total_seconds()


def summary(job: Job) -> dict:
    assert job.result is not None
    assert job.result.summary is not None
    return job.result.summary
