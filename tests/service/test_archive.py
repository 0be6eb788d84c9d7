"""A rig as one ZIP file: complete, the same bytes every time, made while it is sent."""

from __future__ import annotations

import hashlib
import io
import json
import threading
import tracemalloc
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from service.rigs import archive, repository
from service.rigs.archive import Member, archive_of, lay_out, length
from service.rigs.download import ByteRange
from service.settings import Settings
from service.store.database import Store
from service.store.files import Files
from service.store.integrity import open_checked
from service.store.models import Subject
from tests.service_client import Studio, eventually, served

OF_RIG = ("rig.npz", "rig.glb", "fit_smile.png")
OF_MODEL = ("model.npz", "model.json")


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    archive._checksum.cache_clear()
    with served(Settings(data_dir=tmp_path)) as studio:
        yield studio


def store_of(studio: Studio) -> Store:
    store: Store = studio.http.app.state.store  # type: ignore[attr-defined]
    return store


def rigged(studio: Studio, folder: Path, template_id: str | None = None) -> dict[str, Any]:
    """Return a rig, whose files hold their own names many times."""
    files = store_of(studio).files

    def left(*names: str) -> dict[str, str]:
        for name in names:
            (folder / name).write_bytes(name.encode() * 1000)
        return {name: files.put(folder / name).sha256 for name in names}

    subject = studio.post("/v1/subjects", name="Alex", template_id=template_id)["id"]
    studio.capture(subject, "neutral", "neutral")
    model = studio.submit("build_model", subject)
    studio.pretend(model, left(*OF_MODEL))
    smile = studio.capture(subject, "smile")
    fit = studio.submit("fit_geometry", subject, captures=[smile])
    made = {"subject_id": subject, "model_job_id": model}
    studio.pretend(fit, left(*OF_RIG), rig=made)
    rig = studio.job(fit)["result"]["rig_id"]
    return {"rig": rig, "fit": fit, **made, "path": f"/v1/rigs/{rig}/archive"}


@pytest.mark.long
def test_it_is_complete_and_says_of_each_file_which_job_left_it(
    studio: Studio, tmp_path: Path
) -> None:
    content = b"an anatomy" * 5000
    upload = studio.upload("anatomy.npz", content)
    template = studio.post("/v1/templates", name="House head", upload_id=upload)["id"]
    made = rigged(studio, tmp_path, template)
    answer = studio.http.get(made["path"])
    packed = zipfile.ZipFile(io.BytesIO(answer.content))
    assert packed.testzip() is None
    note = json.loads(packed.read("rig.json"))
    assert "Content-Encoding" not in answer.headers  # though the client takes gzip
    assert answer.headers["ETag"] == f'"{hashlib.sha256(packed.read("rig.json")).hexdigest()}"'
    jobs = dict.fromkeys(OF_RIG, (made["fit"], "fit_geometry"))
    jobs |= dict.fromkeys(OF_MODEL, (made["model_job_id"], "build_model"))
    jobs["template.npz"] = (None, "template")
    assert {each["name"]: (each["job_id"], each["kind"]) for each in note["artifacts"]} == jobs
    assert packed.namelist() == ["rig.json", *(each["name"] for each in note["artifacts"])]
    for each in note["artifacts"]:
        found = packed.read(each["name"])
        assert hashlib.sha256(found).hexdigest() == each["sha256"], each
    assert packed.read("rig.npz") == b"rig.npz" * 1000
    assert packed.read("template.npz") == content
    assert note["template"] == {"id": template, "name": "House head"}
    assert note["subject"]["name"] == "Alex"
    assert (note["name"], note["labels"]) == ("", {})
    assert {key: note[key] for key in ("id", "job_id")} == {
        "id": made["rig"],
        "job_id": made["fit"],
    }
    assert {info.compress_type for info in packed.infolist()} == {zipfile.ZIP_STORED}
    # programs that unpack a stream want sizes and checksums before the files
    assert not any(info.flag_bits & 8 for info in packed.infolist())


@pytest.mark.long
def test_a_template_that_was_deleted_is_not_the_built_in_one(
    studio: Studio, tmp_path: Path
) -> None:
    def template_of(path: str) -> Any:
        packed = zipfile.ZipFile(io.BytesIO(studio.http.get(path).content))
        assert "template.npz" not in packed.namelist()
        return json.loads(packed.read("rig.json"))["template"]

    assert template_of(rigged(studio, tmp_path)["path"]) is None
    content = b"an anatomy" * 5000
    upload = studio.upload("anatomy.npz", content)
    template = studio.post("/v1/templates", name="House head", upload_id=upload)["id"]
    made = rigged(studio, tmp_path, template)
    with store_of(studio).of("default").write() as session:
        session.query(Subject).filter_by(id=made["subject_id"]).update({"template_id": None})
    assert studio.http.delete(f"/v1/templates/{template}").status_code == 204
    found = template_of(made["path"])
    assert found == {"sha256": hashlib.sha256(content).hexdigest(), "missing": True}


@pytest.mark.long
def test_every_range_is_that_of_the_whole(studio: Studio, tmp_path: Path) -> None:
    made = rigged(studio, tmp_path)
    head = studio.http.head(made["path"])
    whole = studio.http.get(made["path"])
    content = whole.content
    tag = whole.headers["ETag"]
    for name in ("ETag", "Content-Length", "Content-Type", "Accept-Ranges"):
        assert head.headers[name] == whole.headers[name]
    assert head.headers["Content-Type"] == "application/zip"
    assert studio.http.get(made["path"]).content == content
    size = len(content)
    assert head.headers["Content-Length"] == str(size)
    for start in [0, 1, 29, *range(30, size, 1997), size - 1]:
        end = min(start + 5000, size)
        headers = {"Range": f"bytes={start}-{end - 1}", "If-Range": tag}
        part = studio.http.get(made["path"], headers=headers)
        assert part.status_code == 206
        assert part.headers["Content-Range"] == f"bytes {start}-{end - 1}/{size}"
        assert part.content == content[start:end], (start, end)
    assert studio.http.get(made["path"], headers={"If-None-Match": tag}).status_code == 304
    other = {"Range": "bytes=5-9", "If-Range": '"another"'}
    assert studio.http.get(made["path"], headers=other).content == content
    beyond = studio.http.get(made["path"], headers={"Range": f"bytes={size}-"})
    assert (beyond.status_code, beyond.headers["Content-Range"]) == (416, f"bytes */{size}")


@pytest.mark.long
def test_a_preview_that_was_made_since_is_in_another_archive(
    studio: Studio, tmp_path: Path
) -> None:
    made = rigged(studio, tmp_path)
    before = studio.http.head(made["path"]).headers
    preview = studio.submit("build_preview", made["subject_id"], rig_id=made["rig"])
    studio.pretend(preview, {"preview.bin": store_of(studio).files.put(Path(__file__)).sha256})
    answer = studio.http.get(made["path"], headers={"If-None-Match": before["ETag"]})
    assert answer.status_code == 200
    packed = zipfile.ZipFile(io.BytesIO(answer.content))
    assert packed.read("preview.bin") == Path(__file__).read_bytes()
    assert packed.testzip() is None


@pytest.mark.long
def test_of_two_who_want_it_at_once_one_reads_its_files(
    studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = rigged(studio, tmp_path)
    store = store_of(studio)
    both = threading.Barrier(2)
    read = []

    def read_beside(files: Files, sha256: str) -> Iterator[bytes]:
        read.append(sha256)
        with suppress(threading.BrokenBarrierError):
            both.wait(0.5)  # for the other one to read as well
        return open_checked(files, sha256)

    monkeypatch.setattr(archive, "open_checked", read_beside)
    with store.read() as session:
        found = archive_of(session, repository.get(session, made["rig"]), store)
    threads = [threading.Thread(target=found.blocks, args=(ByteRange(0, 1),)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(read) == sorted(each.sha256 for each in found.members if each.content is None)


@pytest.mark.long
@pytest.mark.parametrize("fault", ["lost", "damaged"])
def test_a_faulty_file_is_named_before_anything_is_sent(
    studio: Studio, tmp_path: Path, fault: str
) -> None:
    made = rigged(studio, tmp_path)
    stored = store_of(studio).files.path(  # type: ignore[attr-defined]
        hashlib.sha256(b"model.npz" * 1000).hexdigest()
    )
    stored.chmod(0o600)
    if fault == "lost":
        stored.unlink()
    else:
        stored.write_bytes(b"MODEL.npz" * 1000)
    for _ in range(2):
        answer = studio.http.get(made["path"])
        assert (answer.status_code, answer.json()["code"]) == (410, "files.lost")
        assert answer.json()["detail"] == f"model.npz is {fault} in the file store"
    stored.write_bytes(b"model.npz" * 1000)
    assert studio.http.get(made["path"]).status_code == 200


@pytest.mark.long
def test_a_file_that_is_damaged_later_cuts_the_answer_off_and_is_told_then(
    studio: Studio, tmp_path: Path
) -> None:
    made = rigged(studio, tmp_path)
    assert studio.http.get(made["path"]).status_code == 200
    stored = store_of(studio).files.path(  # type: ignore[attr-defined]
        hashlib.sha256(b"model.npz" * 1000).hexdigest()
    )
    stored.chmod(0o600)
    stored.write_bytes(b"MODEL.npz" * 1000)
    with pytest.raises(Exception, match="damaged"):
        studio.http.get(made["path"])
    answer = studio.http.get(made["path"], headers={"Range": "bytes=0-9"})
    assert (answer.status_code, answer.json()["code"]) == (410, "files.lost")


@pytest.mark.long
def test_a_rig_that_is_being_deleted_is_not_copied(studio: Studio, tmp_path: Path) -> None:
    made = rigged(studio, tmp_path)
    job = made["fit"]
    path = f"/v1/subjects/{made['subject_id']}"
    running = studio.submit("build_preview", made["subject_id"], rig_id=made["rig"])
    with store_of(studio).write() as session:
        from service.queue import table

        assert table.take(session, running, "test", 60)
    assert studio.http.delete(path, params={"cancel": True}).status_code == 202
    answer = studio.http.get(made["path"])
    assert (answer.status_code, answer.json()["code"]) == (410, "rig.deleting")
    assert "is being deleted" in answer.json()["detail"]
    assert studio.job(job)["state"] == "succeeded"  # nothing else is in its way


def test_a_rig_that_is_deleted_between_two_looks_is_not_there(
    studio: Studio, tmp_path: Path
) -> None:
    made = rigged(studio, tmp_path)
    store = store_of(studio)
    with store.read() as session:
        found = archive_of(session, repository.get(session, made["rig"]), store)
    assert studio.http.delete(f"/v1/subjects/{made['subject_id']}").status_code == 204
    (tmp_path / "files").rename(tmp_path / "gone")
    (tmp_path / "files" / "aside").mkdir(parents=True)
    from service.errors import Problem

    with pytest.raises(Problem) as caught:
        found.blocks(ByteRange(0, found.size))
    assert (caught.value.status, caught.value.code) == (404, "rig.unknown")
    assert studio.http.get(made["path"]).status_code == 404


@pytest.mark.long
def test_a_slow_reader_holds_neither_the_file_nor_a_session(
    studio: Studio, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "OF_RIG", ("rig.npz",))
    made = rigged(studio, tmp_path)
    store = store_of(studio)
    (tmp_path / "large").write_bytes(bytes(64 * 1024**2))
    blob = store.files.put(tmp_path / "large")
    from service.store.models import Artifact

    with store.of("default").write() as session:
        row = session.query(Artifact).filter_by(job_id=made["fit"], name="rig.npz").one()
        row.sha256 = blob.sha256
        row.size = blob.size
    with store.read() as session:
        found = archive_of(session, repository.get(session, made["rig"]), store)
    tracemalloc.start()
    blocks = found.blocks(ByteRange(0, found.size))
    read = len(next(blocks))
    assert store.database.engine.pool.checkedout() == 0  # type: ignore[attr-defined]
    read += sum(map(len, blocks))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert read == found.size > 64 * 1024**2
    assert peak < 8 * 1024**2


@pytest.mark.long
def test_whoever_took_it_is_written_down(studio: Studio, tmp_path: Path) -> None:
    made = rigged(studio, tmp_path)
    path = f"/v1/audit?object_id={made['rig']}"
    tag = studio.http.head(made["path"]).headers["ETag"]
    studio.http.get(made["path"], headers={"If-None-Match": tag})
    studio.http.get(made["path"], headers={"X-Request-Id": "took-it"})
    eventually(lambda: bool(studio.get(path)["items"]), seconds=60)
    [entry] = studio.get(path)["items"]
    assert (entry["action"], entry["request_id"]) == ("rig.downloaded", "took-it")


@pytest.mark.long
@pytest.mark.parametrize("count", [3, 70_000])
def test_large_archives_are_what_zipfile_reads(tmp_path: Path, count: int) -> None:
    """Beyond 4 GiB, or 65,535 files, by a sparse file with the layout's own bytes."""
    large = 5 * 1024**3 if count == 3 else 1
    members = [Member(f"file-{number}", large, "") for number in range(count)]
    made = datetime(2026, 11, 22, 19, 2, tzinfo=UTC)
    parts = lay_out([(each, zlib.crc32(b"\0")) for each in members], made)
    path = tmp_path / "large.zip"
    with path.open("wb") as file:
        for part in parts:
            if isinstance(part, bytes):
                file.write(part)
            else:
                file.seek(part.size, io.SEEK_CUR)
    assert path.stat().st_size == sum(map(length, parts))
    with zipfile.ZipFile(path) as packed:
        found = packed.infolist()
        assert [each.filename for each in found] == [each.name for each in members]
        assert {each.file_size for each in found} == {large}
        assert found[0].date_time == (2026, 11, 22, 19, 2, 0)
        with packed.open(found[-1]) as last:
            assert last.read(1) == b"\0"
