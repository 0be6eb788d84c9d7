"""An installation of a release before is served by this one: jobs that waited end, nothing is lost.

`tests/fixtures/make_installation.py` says how the data folder was made, by the code of its commit.
"""

from __future__ import annotations

import hashlib
import json
import tarfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.service_client import FINAL, Studio, eventually, running

INSTALLATIONS = sorted((Path(__file__).parents[1] / "fixtures").glob("installation-*.tar.xz"))
# Members that the work after the upgrade changes, by list
MOVING = {
    "captures": {"check", "registration"},
    "keys": {"last_used_at"},
    "rigs": {"artifacts"},  # a rig's own path shows the preview, too, that a test here has made
}
LONG = 1e10  # seconds; that of the maker


class Upgraded(NamedTuple):
    """The service on the data folder, and what the release before said of it."""

    studio: Studio
    data: Path
    expected: dict[str, Any]

    def now(self, name: str) -> dict[str, dict[str, Any]]:
        """Return the objects of a list by their ids; lists show jobs and rigs in short."""
        path = {
            "captures": f"/v1/subjects/{self.expected['ids']['subject']}/captures",
            "deliveries": f"/v1/webhooks/{self.expected['lists']['webhooks'][0]['id']}/deliveries",
        }.get(name, f"/v1/{name}")
        items = self.studio.get(f"{path}?limit=1000")["items"]
        if name in ("jobs", "rigs"):
            items = [self.studio.get(f"{path}/{each['id']}") for each in items]
        return {each["id"]: each for each in items}


@pytest.fixture(scope="module", autouse=True)
def parts() -> None:
    """Run once: the data folder brings its own SQLite and files."""


@pytest.fixture(scope="module", params=INSTALLATIONS, ids=lambda path: path.name.split(".")[0])
def upgraded(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Upgraded]:
    data = tmp_path_factory.mktemp("upgrade") / "data"
    with tarfile.open(request.param) as archive:
        # Debian 12's Python is older than the argument of that name.
        archive.extraction_filter = getattr(tarfile, "data_filter", None)
        archive.extractall(data)
    expected = json.loads((data / "expected.json").read_text())
    with running(data, upload_ttl=LONG, retain_audit=None) as (_, studio):
        yield Upgraded(studio, data, expected)


def test_every_waiting_job_ends(upgraded: Upgraded) -> None:
    waiting = upgraded.expected["ids"]["waiting"]
    assert len(waiting) == 10
    for kind, job_id in waiting.items():
        job = upgraded.studio.finished(job_id, seconds=120)
        assert (job["kind"], job["state"]) == (kind, "succeeded"), job


def test_a_job_goes_on_with_its_frames(upgraded: Upgraded) -> None:
    job_id = upgraded.expected["ids"]["frames"]
    before = upgraded.expected["frames"]
    assert len(before) >= 6
    job = upgraded.studio.finished(job_id, seconds=120)
    assert job["state"] == "succeeded", job
    frames = upgraded.studio.get(f"/v1/jobs/{job_id}/frames")["frames"]
    assert frames[: len(before)] == before
    assert [frame["frame"] for frame in frames] == list(range(20))


def test_a_batch_goes_on(upgraded: Upgraded) -> None:
    path = f"/v1/batches/{upgraded.expected['ids']['batch']}"
    eventually(lambda: upgraded.studio.get(path)["state"] != "running", seconds=120)
    batch = upgraded.studio.get(path)
    assert (batch["state"], batch["error"]) == ("succeeded", None), batch
    assert upgraded.studio.get(f"/v1/rigs/{batch['fit']['rig_id']}")["expressions"] == ["smile"]


def test_a_rig_of_its_four_files_is_fitted_and_played(upgraded: Upgraded) -> None:
    ids = upgraded.expected["ids"]
    studio = upgraded.studio
    names = {each["name"] for each in studio.get(f"/v1/rigs/{ids['rig']}")["artifacts"]}
    assert names >= {"activations.npz", "muscle_weights.npz"}
    assert "rig.npz" not in names
    fit = {"captures": [ids["smile"]], "rig_id": ids["rig"]}
    child = studio.done("fit_activations", ids["subject"], **fit)["result"]["rig_id"]
    assert {"smile", "frown"} <= set(studio.get(f"/v1/rigs/{child}")["expressions"])
    for rig in (ids["rig"], child):
        studio.done("build_preview", ids["subject"], rig_id=rig)


def test_the_other_tenants_job_ends(upgraded: Upgraded) -> None:
    mine = upgraded.studio.http.headers["Authorization"]
    other = Studio(upgraded.studio.http, (upgraded.data / "other.key").read_text())
    try:
        [job] = other.get("/v1/jobs")["items"]
        assert other.finished(job["id"], seconds=120)["state"] == "succeeded"
        assert other.get("/v1/usage")["queued"]["limit"] == 5
    finally:
        upgraded.studio.http.headers["Authorization"] = mine


@pytest.mark.parametrize(
    "name",
    [
        "subjects",
        "captures",
        "jobs",
        "batches",
        "rigs",
        "templates",
        "webhooks",
        "deliveries",
        "keys",
        "audit",
        "deletions",
    ],
)
def test_every_row_is_as_it_was(name: str, upgraded: Upgraded) -> None:
    now = upgraded.now(name)
    for before in upgraded.expected["lists"][name]:
        after = now[before["id"]]
        same = before.keys() - MOVING.get(name, set())
        if name in ("jobs", "batches") and before["state"] not in FINAL:
            same &= {"id", "kind", "name", "subject_id", "priority", "created_at"}
        assert {key: _known(after[key], before[key]) for key in same} == {
            key: before[key] for key in same
        }


def _known(after: Any, before: Any) -> Any:
    """Return what there is now without the members that the release before did not know."""
    if isinstance(after, dict) and isinstance(before, dict):
        return {key: _known(after[key], before[key]) for key in before}
    if isinstance(after, list) and isinstance(before, list) and len(after) == len(before):
        return [_known(*each) for each in zip(after, before, strict=True)]
    return after


def test_every_file_is_there(upgraded: Upgraded) -> None:
    lists = upgraded.expected["lists"]
    files = [file for rig in lists["rigs"] for file in rig["artifacts"]]
    files += [file for job in lists["jobs"] if job["result"] for file in job["result"]["artifacts"]]
    assert len(files) >= 10
    for file in files:
        content = upgraded.studio.http.get(f"/v1/artifacts/{file['id']}").content
        assert hashlib.sha256(content).hexdigest() == file["sha256"]


def test_half_an_upload_is_completed(upgraded: Upgraded) -> None:
    location = upgraded.expected["ids"]["upload"]
    head = upgraded.studio.http.head(location)
    assert head.headers["Upload-Offset"] == "4"
    assert upgraded.studio.send(location, 4, b" of it").status_code == 204
