"""The typed client against a running service, over a line that breaks."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from myoface import transfer
from myoface.client import Client
from myoface.credentials import VARIABLE
from myoface.errors import ApiError
from myoface.resources import Job
from tests.service_client import running


class BreakingLine(httpx.HTTPTransport):
    """A connection that breaks at every third request, after the service has read it."""

    def __init__(self) -> None:
        super().__init__()
        self.requests = 0

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        response = super().handle_request(request)
        self.requests += 1
        if self.requests % 3 == 0:
            response.close()
            raise httpx.ReadError("the line broke", request=request)
        return response


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with (
        running(tmp_path_factory.mktemp("stack")) as (stack, _),
        pytest.MonkeyPatch.context() as environment,
    ):
        environment.setenv(VARIABLE, stack.key)
        yield stack.url


@pytest.fixture
def client(url: str) -> Iterator[Client]:
    with Client(url) as client:
        yield client


@pytest.fixture
def breaking(url: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    """A client on a breaking line that sends small chunks."""
    monkeypatch.setattr(transfer, "CHUNK_BYTES", 64 * 1024)
    with Client(url) as client:
        line = BreakingLine()
        client.http = httpx.Client(base_url=url, headers=client.http.headers, transport=line)
        yield client


def scan(folder: Path, name: str, *orders: str) -> Path:
    path = folder / f"{name}.obj"
    path.write_text("\n".join([f"# {name}", *(f"#! {order}" for order in orders)]))
    return path


def subject_with_model(client: Client, folder: Path) -> str:
    subject = client.create_subject("Ada")
    client.add_capture(subject.id, scan(folder, "neutral"), role="neutral")
    client.wait(client.submit("build_model", subject.id).id)
    return subject.id


def test_upload_survives_a_breaking_line(breaking: Client, client: Client, tmp_path: Path) -> None:
    path = tmp_path / "big.obj"
    path.write_bytes(os.urandom(1_000_001))
    offsets: list[int] = []
    # Starting an upload is not repeated by itself: it would leave a second one behind.
    begun = client.http.post(
        "/v1/uploads", headers={"Upload-Length": "1000001", "Upload-Metadata": metadata(path)}
    )
    upload_id = begun.headers["Location"].rsplit("/", 1)[-1]
    sent = breaking.upload(path, resume=upload_id, progress=lambda done, _: offsets.append(done))
    assert (sent.id, sent.state, sent.sha256) == (upload_id, "complete", transfer.sha256_of(path))
    assert offsets[-1] == 1_000_001


def metadata(path: Path) -> str:
    return transfer.metadata(path.name, transfer.sha256_of(path))


def test_resume_refuses_another_file(client: Client, tmp_path: Path) -> None:
    started: list[str] = []
    client.upload(scan(tmp_path, "smile"), started=started.append)
    with pytest.raises(ApiError) as caught:
        client.upload(scan(tmp_path, "frown"), resume=started[0])
    assert caught.value.code == "client.changed"


def test_a_job_is_followed_over_a_breaking_line(
    breaking: Client, client: Client, tmp_path: Path
) -> None:
    subject = client.create_subject("Ada")
    client.add_capture(subject.id, scan(tmp_path, "neutral", "seconds 2"), role="neutral")
    seen: list[Job] = []
    job = breaking.wait(client.submit("build_model", subject.id).id, seen.append)
    assert job.state == "succeeded"
    assert {each.progress.phase for each in seen if each.progress} == {"geometry"}


def test_who_comes_late_is_not_told_the_old_news(client: Client, tmp_path: Path) -> None:
    subject = client.create_subject("Ada")
    client.add_capture(subject.id, scan(tmp_path, "neutral", "seconds 2"), role="neutral")
    job = client.submit("build_model", subject.id)
    while (begun := client.job(job.id)).progress is None or not begun.progress.iteration:
        time.sleep(0.05)
    seen: list[Job] = []
    client.wait(job.id, seen.append)
    iterations = [each.progress.iteration or 0 for each in seen if each.progress]
    assert iterations == sorted(iterations)
    assert iterations[0] >= begun.progress.iteration


def test_lists_are_read_to_their_end(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("myoface.client.LONGEST_PAGE", 2)
    made = [client.create_subject(f"number {number}").id for number in range(5)]
    assert [each.id for each in client.subjects()][:5] == made[::-1]


def test_a_failed_job_is_an_error_that_locates_the_fault(client: Client, tmp_path: Path) -> None:
    subject = client.create_subject("Ada")
    client.add_capture(subject.id, scan(tmp_path, "neutral", "fault nan"), role="neutral")
    with pytest.raises(ApiError, match=r"NaN.*line 3.*scan\.nan"):
        client.wait(client.submit("build_model", subject.id).id)
    assert [job.kind for job in client.jobs(subject_id=subject.id, state="failed")] == [
        "build_model"
    ]


def test_download_goes_on_and_is_checked(client: Client, tmp_path: Path) -> None:
    subject = subject_with_model(client, tmp_path)
    smile = client.add_capture(subject, scan(tmp_path, "smile"))
    job = client.wait(client.submit("fit_geometry", subject, captures=[smile.id]).id)
    assert job.result is not None
    glb = next(each for each in job.result.artifacts if each.name == "rig.glb")
    whole = tmp_path / "rig.glb"
    part = transfer.part_path(whole, glb)
    client.download(glb, whole)
    content = whole.read_bytes()

    whole.unlink()
    part.write_bytes(content[:1000])
    received: list[int] = []
    client.download(glb, whole, progress=lambda done, _: received.append(done))
    assert whole.read_bytes() == content
    assert received[0] > 1000

    whole.unlink()
    part.write_bytes(b"x" * 1000)
    with pytest.raises(ApiError) as caught:
        client.download(glb, whole)
    assert caught.value.code == "client.checksum"
    assert not whole.exists()
    assert not part.exists()


def test_nobody_there_is_said_plainly(tmp_path: Path) -> None:
    with Client("http://127.0.0.1:9") as client, pytest.raises(ApiError) as caught:
        client.subjects()
    assert caught.value.code == "client.unreachable"
