"""Fetching assets from a server that breaks off, changes its mind, or sends something else."""

from __future__ import annotations

import hashlib
import io
import json
import threading
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import numpy as np
import pytest

from myoface.assets.catalogue import CATALOGUE, PublicAsset
from myoface.assets.fetch import RECORD, fetch
from myoface.errors import ApiError
from service.settings import Settings
from solver import landmarker
from solver.errors import InputError
from tests.command_line import invoke
from worker.caches import TenantCache


def archive(seed: int = 0) -> bytes:
    """Return a ZIP that holds one mesh and enough noise to be sent in several blocks."""
    noise = np.random.default_rng(seed).bytes(300_000)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as packed:
        packed.writestr("model/mesh.obj", f"# {seed}\n")
        packed.writestr("model/noise.bin", noise)
    return stream.getvalue()


@dataclass
class Shelf:
    """What the server sends: ``cuts`` are the bytes after which it hangs up, one a request."""

    content: bytes = field(default_factory=archive)
    cuts: list[int] = field(default_factory=list)
    ranges: bool = True
    etag: bool = True
    length: bool = True
    asked: list[str | None] = field(default_factory=list)
    url: str = ""

    @property
    def tag(self) -> str:
        return f'"{hashlib.md5(self.content).hexdigest()}"'


def handler(shelf: Shelf) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range")
            shelf.asked.append(wanted)
            if not self.path.endswith("asset.zip"):
                self.send_error(404)
                return
            fresh = self.headers.get("If-Range") not in (None, shelf.tag)
            start = 0
            if wanted and shelf.ranges and not fresh:
                start = int(wanted.removeprefix("bytes=").removesuffix("-"))
            if start >= len(shelf.content):
                self.send_error(416)
                return
            body = shelf.content[start:]
            self.send_response(206 if start else 200)
            if shelf.length:
                self.send_header("Content-Length", str(len(body)))
            if shelf.etag:
                self.send_header("ETag", shelf.tag)
            self.end_headers()
            self.wfile.write(body[: shelf.cuts.pop(0)] if shelf.cuts else body)

        def log_message(self, *_: object) -> None:
            pass

    return Handler


@pytest.fixture
def shelf() -> Iterator[Shelf]:
    shelf = Shelf()
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler(shelf))
    shelf.url = f"http://127.0.0.1:{server.server_port}/asset.zip"
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    yield shelf
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def http() -> Iterator[httpx.Client]:
    with httpx.Client(follow_redirects=True) as client:
        yield client


def pinned(shelf: Shelf) -> PublicAsset:
    """Return an asset whose size and hash are known, as of BodyParts3D."""
    content = shelf.content
    return replace(
        CATALOGUE["bodyparts3d"],
        url=shelf.url,
        file="asset.zip",
        size=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
        members={"mesh.obj": None},
    )


def unpinned(shelf: Shelf, mesh: str | None = None) -> PublicAsset:
    """Return an asset of which only a member is known, as of ICT-FaceKit."""
    members = {"model/mesh.obj": mesh}
    return replace(pinned(shelf), size=None, sha256=None, members=members)


def test_broken_download_goes_on_where_it_broke(
    shelf: Shelf, http: httpx.Client, tmp_path: Path
) -> None:
    shelf.cuts = [100_000, 50_000]
    heard: list[tuple[int, int]] = []
    path = fetch(http, pinned(shelf), tmp_path, progress=lambda *step: heard.append(step))
    assert path.read_bytes() == shelf.content
    assert shelf.asked[0] is None
    assert [asked for asked in shelf.asked[1:] if asked is None] == []
    assert heard[-1] == (len(shelf.content),) * 2
    assert sorted(file.name for file in tmp_path.iterdir()) == ["LICENCE.txt", "asset.zip", RECORD]
    assert "CC Attribution 4.0" in (tmp_path / "LICENCE.txt").read_text()


def test_later_run_goes_on_with_the_part(shelf: Shelf, http: httpx.Client, tmp_path: Path) -> None:
    (tmp_path / "asset.zip.part").write_bytes(shelf.content[:1000])
    fetch(http, pinned(shelf), tmp_path)
    assert shelf.asked == ["bytes=1000-"]


def test_early_end_is_seen_without_a_length(
    shelf: Shelf, http: httpx.Client, tmp_path: Path
) -> None:
    shelf.length = False
    shelf.cuts = [1000]
    assert fetch(http, pinned(shelf), tmp_path).read_bytes() == shelf.content
    assert shelf.asked == [None, "bytes=1000-"]


def test_server_without_ranges_sends_it_anew(
    shelf: Shelf, http: httpx.Client, tmp_path: Path
) -> None:
    shelf.ranges = False
    shelf.cuts = [1000]
    assert fetch(http, pinned(shelf), tmp_path).read_bytes() == shelf.content


@pytest.mark.parametrize("etag", [True, False])
def test_part_of_an_older_version_is_not_continued(
    etag: bool, shelf: Shelf, http: httpx.Client, tmp_path: Path
) -> None:
    shelf.etag = etag
    (tmp_path / "asset.zip.part").write_bytes(archive(seed=1)[:1000])
    (tmp_path / "asset.zip.part.etag").write_text('"older"') if etag else None
    assert fetch(http, unpinned(shelf), tmp_path).read_bytes() == shelf.content


def test_wrong_file_is_not_kept(shelf: Shelf, http: httpx.Client, tmp_path: Path) -> None:
    asset = pinned(shelf)
    shelf.content = archive(seed=1)
    with pytest.raises(InputError, match=r"asset\.zip has sha256 .* not kept") as caught:
        fetch(http, asset, tmp_path)
    assert caught.value.code == "assets.hash"
    assert caught.value.context["expected"] == asset.sha256
    assert list(tmp_path.iterdir()) == []


def test_page_of_a_proxy_is_no_archive(shelf: Shelf, http: httpx.Client, tmp_path: Path) -> None:
    shelf.content = b"<html>Please log in</html>"
    with pytest.raises(InputError, match="no ZIP archive") as caught:
        fetch(http, unpinned(shelf), tmp_path)
    assert caught.value.code == "assets.content"
    assert list(tmp_path.iterdir()) == []


def test_other_version_of_a_member_is_not_kept(
    shelf: Shelf, http: httpx.Client, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"another version of model/mesh\.obj"):
        fetch(http, unpinned(shelf, mesh="0" * 64), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_first_copy_is_trusted_and_remembered(
    shelf: Shelf, http: httpx.Client, tmp_path: Path
) -> None:
    fetch(http, unpinned(shelf), tmp_path).unlink()
    record = json.loads((tmp_path / RECORD).read_text())["asset.zip"]
    assert record["sha256"] == hashlib.sha256(shelf.content).hexdigest()
    assert (record["source"], record["expected"]) == (shelf.url, "first use")
    shelf.content = archive(seed=1)
    with pytest.raises(InputError, match=r"first copy had \(fetched\.json\)"):
        fetch(http, unpinned(shelf), tmp_path)
    assert not (tmp_path / "asset.zip").exists()


def test_what_is_there_is_checked_and_not_fetched_again(
    shelf: Shelf, http: httpx.Client, tmp_path: Path
) -> None:
    path = fetch(http, pinned(shelf), tmp_path)
    fetch(http, pinned(shelf), tmp_path)
    assert len(shelf.asked) == 1
    path.write_bytes(b"changed")
    with pytest.raises(InputError, match="delete it"):
        fetch(http, pinned(shelf), tmp_path)
    assert path.read_bytes() == b"changed"


def test_mirror_and_missing_file(shelf: Shelf, http: httpx.Client, tmp_path: Path) -> None:
    asset = replace(pinned(shelf), url="http://127.0.0.1:9/unused.zip")
    mirror = shelf.url.removesuffix("asset.zip") + "mirror/"
    assert fetch(http, asset, tmp_path, mirror=mirror).exists()
    with pytest.raises(ApiError) as caught:
        fetch(http, replace(asset, file="none.zip"), tmp_path, mirror=mirror)
    assert caught.value.code == "http.404"


def test_copy_at_hand(shelf: Shelf, http: httpx.Client, tmp_path: Path) -> None:
    copy = tmp_path / "from a colleague.zip"
    copy.write_bytes(shelf.content)
    path = fetch(http, pinned(shelf), tmp_path / "to", file=copy)
    assert path.read_bytes() == shelf.content
    assert shelf.asked == []
    other = hashlib.sha256(b"other").hexdigest()
    with pytest.raises(InputError, match="which you gave"):
        fetch(http, pinned(shelf), tmp_path / "elsewhere", file=copy, sha256=other)


def test_nothing_is_fetched_without_the_licence(
    shelf: Shelf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(CATALOGUE, "bodyparts3d", pinned(shelf))
    command = ["assets", "fetch", "bodyparts3d", "--to", str(tmp_path / "to")]
    refused = invoke(command)
    assert refused.exit_code != 0
    assert "CC Attribution 4.0" in refused.output
    assert shelf.asked == []
    accepted = invoke([*command, "--accept-licence"])
    assert accepted.exit_code == 0, accepted.output
    assert (tmp_path / "to" / "asset.zip").read_bytes() == shelf.content


def landmarker_on(shelf: Shelf) -> PublicAsset:
    """Return the landmarker as the shelf has it, its file being the mesh."""
    asset = replace(CATALOGUE["landmarker"], members={"mesh.obj": None}, unpacked="mesh.obj")
    known = {"size": len(shelf.content), "sha256": hashlib.sha256(shelf.content).hexdigest()}
    return replace(asset, url=shelf.url, file="asset.zip", **known)  # type: ignore[arg-type]


def test_a_file_that_programs_read_is_laid_beside_its_archive(
    shelf: Shelf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(CATALOGUE, "landmarker", landmarker_on(shelf))
    command = ["assets", "fetch", "landmarker", "--to", str(tmp_path / "to"), "--accept-licence"]
    told = invoke(command)
    assert told.exit_code == 0, told.output
    assert "Apache License" in told.output
    unpacked = tmp_path / "to" / "mesh.obj"
    assert f"MYOFACE_FACE_LANDMARKER={unpacked}" in told.output.replace("\n", "")
    with zipfile.ZipFile(tmp_path / "to" / "asset.zip") as archive:
        assert unpacked.read_bytes() == archive.read("model/mesh.obj")
    assert invoke(command).exit_code == 0


def test_the_landmarker_is_found_where_it_is_fetched_to(
    shelf: Shelf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A solver process finds it, too: its cache folder links the files of the installation's."""
    monkeypatch.setitem(CATALOGUE, "landmarker", landmarker_on(shelf))
    monkeypatch.setattr(landmarker, "FILE", "mesh.obj")
    monkeypatch.delenv(landmarker.VARIABLE, raising=False)
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path / "cache"))
    assert landmarker.landmarker_file() is None
    told = invoke(["assets", "fetch", "landmarker", "--accept-licence"])
    assert told.exit_code == 0, told.output
    assert landmarker.landmarker_file() == tmp_path / "cache" / "mesh.obj"
    assert landmarker.VARIABLE not in told.output
    kept = TenantCache("tenant", Settings(data_dir=tmp_path / "data"))
    kept.link_into(tmp_path / "attempt")
    monkeypatch.setenv("MYOFACE_CACHE", str(tmp_path / "attempt"))
    found = landmarker.landmarker_file()
    assert found
    assert found.read_bytes() == (tmp_path / "cache" / "mesh.obj").read_bytes()
    monkeypatch.setenv(landmarker.VARIABLE, "other.task")
    assert landmarker.landmarker_file() == Path("other.task")
