"""The typed client against a running service, over a line that breaks."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from pathlib import Path

import anyio
import httpx
import pytest

from myoface.client import AsyncClient, Client, ClientOptions, files
from myoface.client.credentials import KEY_VARIABLE
from myoface.errors import ApiError
from myoface.resources import Job
from myoface.stack import Stack
from service.access.limits import MOST_QUEUED
from tests.service_client import Studio

SMALL = ClientOptions(chunk_bytes=64 * 1024)


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
def url(stack_and_studio: tuple[Stack, Studio]) -> Iterator[str]:
    stack, _ = stack_and_studio
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv(KEY_VARIABLE, stack.key)
        yield stack.url


@pytest.fixture(autouse=True)
def _notes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def client(url: str) -> Iterator[Client]:
    with Client(url, options=SMALL) as client:
        yield client


@pytest.fixture
def breaking(url: str) -> Iterator[Client]:
    """A client on a breaking line."""
    with Client(url, options=SMALL) as client:
        line = BreakingLine()
        client.http = httpx.Client(base_url=url, headers=client.http.headers, transport=line)
        yield client


def scan(folder: Path, name: str, *orders: str) -> Path:
    path = folder / f"{name}.obj"
    path.write_text("\n".join([f"# {name}", *(f"#! {order}" for order in orders)]))
    return path


def subject_with_model(client: Client, folder: Path) -> str:
    subject = client.create_subject("Ada")
    client.add_capture(subject.id, scan(folder, "neutral"), role="neutral", registered=True)
    client.wait(client.submit("build_model", subject.id).id)
    return subject.id


def test_an_upload_goes_on_in_another_run(
    breaking: Client, client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "big.obj"
    path.write_bytes(os.urandom(1_000_001))

    def give_up(done: int, _total: int) -> None:
        if done > 300_000:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        client.upload(path, progress=give_up)
    (note,) = files.notes_folder().iterdir()
    begun = note.read_text()
    offsets: list[int] = []
    sent = breaking.upload(path, progress=lambda done, _: offsets.append(done))
    assert (sent.id, sent.state) == (begun, "complete")
    assert sent.sha256 == files.sha256_of(path)
    assert (offsets[0] > 300_000, offsets[-1]) == (True, 1_000_001)
    assert list(files.notes_folder().iterdir()) == []
    again = client.upload(path)
    assert again.id != sent.id  # that one was complete: this is another


def test_what_the_service_forgot_is_sent_anew(client: Client, tmp_path: Path) -> None:
    path = scan(tmp_path, "smile")
    note = files.UploadNote(str(client.http.base_url).rstrip("/"), path.name, files.sha256_of(path))
    note.write("8c1d3a52-0f4e-4c5b-9b39-1f3a4f1f6c11")
    assert client.upload(path).state == "complete"


def test_a_job_is_followed_over_a_breaking_line(
    breaking: Client, client: Client, tmp_path: Path
) -> None:
    subject = client.create_subject("Ada")
    client.add_capture(
        subject.id, scan(tmp_path, "neutral", "seconds 2"), role="neutral", registered=True
    )
    seen: list[Job] = []
    job = breaking.wait(client.submit("build_model", subject.id).id, seen.append)
    assert job.state == "succeeded"
    assert {each.progress.phase for each in seen if each.progress} == {"geometry"}


def test_who_comes_late_is_not_told_the_old_news(client: Client, tmp_path: Path) -> None:
    subject = client.create_subject("Ada")
    client.add_capture(
        subject.id, scan(tmp_path, "neutral", "seconds 2"), role="neutral", registered=True
    )
    job = client.submit("build_model", subject.id)
    while (begun := client.job(job.id)).progress is None or not begun.progress.iteration:
        time.sleep(0.05)
    seen: list[Job] = []
    client.wait(job.id, seen.append)
    iterations = [each.progress.iteration or 0 for each in seen if each.progress]
    assert iterations == sorted(iterations)
    assert iterations[0] >= begun.progress.iteration


def test_lists_are_read_to_their_end(url: str) -> None:
    with Client(url, options=ClientOptions(page_items=2)) as client:
        made = [client.create_subject(f"number {number}").id for number in range(5)]
        assert [each.id for each in client.subjects()][:5] == made[::-1]


def test_a_failed_job_is_an_error_that_locates_the_fault(client: Client, tmp_path: Path) -> None:
    subject = client.create_subject("Ada")
    client.add_capture(
        subject.id, scan(tmp_path, "neutral", "fault nan"), role="neutral", registered=True
    )
    with pytest.raises(ApiError, match=r"NaN.*line 3.*scan\.nan"):
        client.wait(client.submit("build_model", subject.id).id)
    assert [job.kind for job in client.jobs(subject_id=subject.id, state="failed")] == [
        "build_model"
    ]


def test_download_goes_on_and_is_checked(client: Client, tmp_path: Path) -> None:
    subject = subject_with_model(client, tmp_path)
    smile = client.add_capture(subject, scan(tmp_path, "smile"), registered=True)
    job = client.wait(client.submit("fit_geometry", subject, captures=[smile.id]).id)
    assert job.result is not None
    glb = next(each for each in job.result.artifacts if each.name == "rig.glb")
    whole = tmp_path / "rig.glb"
    part = files.part_path(whole, glb)
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


def test_the_awaited_client_does_the_same(url: str, tmp_path: Path) -> None:
    async def session() -> None:
        async with AsyncClient(url) as client:
            subject = await client.create_subject("Ada")
            await client.add_capture(
                subject.id, scan(tmp_path, "neutral"), role="neutral", registered=True
            )
            names = ("smile", "frown", "kiss")
            added: list[str] = []

            async def add(name: str) -> None:
                added.append(
                    (await client.add_capture(subject.id, scan(tmp_path, name), registered=True)).id
                )

            async with anyio.create_task_group() as stations:
                for name in names:
                    stations.start_soon(add, name)
            seen: list[Job] = []
            await client.run("build_model", subject.id, watch=seen.append)
            assert seen[-1].state == "succeeded"
            fit = await client.run("fit_geometry", subject.id, captures=added)
            assert fit.result is not None
            assert fit.result.rig_id is not None
            for artifact in (await client.rig(fit.result.rig_id)).artifacts:
                await client.download(artifact, tmp_path / artifact.name)
                signed = await client.signed_url(artifact.id)
                assert httpx.get(signed).content == (tmp_path / artifact.name).read_bytes()
            lines = [line.text async for line in client.log(fit.id)]
            assert lines
            with pytest.raises(ApiError, match=r"job\.finished"):
                await client.cancel(fit.id, "too late")
            receipt = await client.delete_subject(subject.id)
            assert (await client.deletion(receipt)).rows_at is not None
            assert await client.jobs(subject_id=subject.id) == []

    anyio.run(session)


def test_keys_from_python(client: Client, url: str) -> None:
    made = client.create_key("station", ["read"])
    with Client(url, made.key) as station:
        assert station.me().scopes == ["read"]
        assert station.usage().queued.limit == MOST_QUEUED
        with pytest.raises(ApiError) as caught:
            station.create_subject("Ada")
        assert (caught.value.status, caught.value.code) == (403, "auth.scope")
        fresh = client.rotate_key(made.id, grace=0)
        with pytest.raises(ApiError, match=r"auth\.expired"):
            station.me()
    client.revoke_key(fresh.id)
    known = client.keys()
    assert {each.id for each in known} >= {made.id, fresh.id}
    assert [each.action for each in client.audit(fresh.id)] == ["key.revoked"]


def test_a_session_in_one_call(client: Client, tmp_path: Path) -> None:
    files = [scan(tmp_path, name) for name in ("smile", "frown")]
    files.append(scan(tmp_path, "blink", "verdict bad"))
    batch = client.create_batch(scan(tmp_path, "neutral"), files, person="Ada")
    done = client.wait_for_batch(batch.id)
    left_out = {each.name: each.left_out for each in done.scans if each.left_out}
    assert list(left_out) == ["blink"]
    assert done.fit is not None
    assert done.fit.rig_id is not None
    assert client.rig(done.fit.rig_id).subject_id == done.subject_id
    assert [each.id for each in client.batches(subject_id=done.subject_id)] == [batch.id]
    again = client.retry(done.fit.job_id, priority=1)
    assert (again.parent_id, again.priority) == (done.fit.job_id, 1)
    assert client.wait(again.id).result is not None


def test_a_rig_is_fetched_whole_and_gone_on_with(client: Client, tmp_path: Path) -> None:
    neutral = scan(tmp_path, "James Neutral 01")
    batch = client.create_batch(None, [neutral, scan(tmp_path, "James Smile 02")], person="James")
    done = client.wait_for_batch(batch.id)
    assert {(each.name, each.role) for each in done.scans} == {
        ("Neutral_01", "neutral"),
        ("Smile_02", "expression"),
    }
    assert done.fit is not None
    assert done.fit.rig_id is not None
    folder = tmp_path / "empty" / "rig"
    steps: list[tuple[int, int]] = []
    rig = client.download_rig(done.fit.rig_id, folder, progress=lambda *step: steps.append(step))
    jobs = {each.name: each.job_id for each in rig.artifacts}
    assert (jobs["model.npz"], jobs["rig.glb"]) == (rig.model_job_id, done.fit.job_id)
    assert {path.name for path in folder.iterdir()} == {*jobs, "rig.json"}
    assert steps[-1][0] == steps[-1][1] > sum(each.size for each in rig.artifacts)
    note = json.loads((folder / "rig.json").read_text())
    assert (note["job_id"], note["subject"]["name"]) == (done.fit.job_id, "James")

    asked: list[httpx.Request] = []
    client.http.event_hooks = {"request": [asked.append]}
    client.download_rig(rig.id, folder)
    assert [each.method for each in asked] == ["HEAD"]  # for a GET all files are read
    damaged, *_ = sorted(folder.glob("*.glb"))
    content = damaged.read_bytes()
    damaged.write_bytes(b"x" * len(content))
    client.download_archive(rig.id, tmp_path / "rig.zip")
    packed = (tmp_path / "rig.zip").read_bytes()
    tag = files.sha256_of(folder / "rig.json")
    (folder / f".rig.zip.{tag[:12]}.part").write_bytes(packed[:1000])
    asked.clear()
    client.download_rig(rig.id, folder)
    wanted = [(each.method, each.headers.get("Range")) for each in asked]
    assert wanted == [("HEAD", None), ("GET", "bytes=1000-")]
    assert damaged.read_bytes() == content
    assert {path.name for path in folder.iterdir()} == {*jobs, "rig.json"}
    with pytest.raises(ApiError, match=r"rig\.unknown"):
        client.download_rig(rig.subject_id, folder)


def test_a_rig_that_is_renamed_while_it_is_fetched_is_fetched_as_it_is_then(
    client: Client, tmp_path: Path
) -> None:
    model = subject_with_model(client, tmp_path)
    smile = scan(tmp_path, "smile")
    fitted = client.add_capture(model, smile, registered=True).id
    job = client.wait(client.submit("fit_geometry", model, captures=[fitted]).id)
    assert job.result is not None
    assert job.result.rig_id is not None
    rig_id = job.result.rig_id
    parts: list[str] = []

    class Breaking(httpx.HTTPTransport):
        """A line that breaks after 1,000 bytes of the first part; the rig is renamed then."""

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            response = super().handle_request(request)
            if "Range" not in request.headers:
                return response
            parts.append(request.headers["Range"])
            if len(parts) > 1:
                return response
            content = response.read()[:1000]
            client.change_rig(rig_id, name="Ada, Tuesday")

            def broken() -> Iterator[bytes]:
                yield content
                raise httpx.ReadError("the line broke", request=request)

            return httpx.Response(206, headers=response.headers, stream=Broken(broken()))

    class Broken(httpx.SyncByteStream):
        def __init__(self, blocks: Iterator[bytes]) -> None:
            self._blocks = blocks

        def __iter__(self) -> Iterator[bytes]:
            return self._blocks

    headers = client.http.headers
    with Client(str(client.http.base_url), options=SMALL) as other:
        other.http = httpx.Client(
            base_url=client.http.base_url, headers=headers, transport=Breaking()
        )
        rig = other.download_rig(rig_id, tmp_path / "rig")
    assert parts == ["bytes=0-", "bytes=1000-", "bytes=0-"]
    assert rig.name == "Ada, Tuesday"
    left = {path.name for path in (tmp_path / "rig").iterdir()}
    assert left == {*(each.name for each in rig.artifacts), "rig.json"}


def test_a_scan_goes_when_its_successor_is_there(client: Client, tmp_path: Path) -> None:
    subject = client.create_subject("Ada")
    first = client.add_capture(subject.id, scan(tmp_path, "NEUTRAL"))
    assert (first.name, first.role, first.registered) == ("NEUTRAL", "neutral", False)
    with pytest.raises(FileNotFoundError):
        client.add_capture(subject.id, tmp_path / "gone.obj", replaces=first.id)
    assert [each.id for each in client.captures(subject.id)] == [first.id]
    smile = client.add_capture(subject.id, scan(tmp_path, "smile"))
    with pytest.raises(ApiError, match=r"capture\.name_taken"):
        client.add_capture(subject.id, tmp_path / "smile.obj", replaces=first.id)
    assert [each.id for each in client.captures(subject.id)] == [smile.id, first.id]
    again = scan(tmp_path, "NEUTRAL", "verdict bad")
    second = client.add_capture(subject.id, again, replaces=first.id)
    assert [each.id for each in client.captures(subject.id)] == [second.id, smile.id]
