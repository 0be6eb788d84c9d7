"""A client asks a service that wants to do harm on its machine."""

from __future__ import annotations

import hashlib
import io
import json
import uuid
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest

from myoface.client import Client
from myoface.errors import ApiError
from myoface.resources import Capture
from tests.command_line import invoke

CONTENT = b"owned"
NAMES = (
    "../../../../x",
    "/etc/cron.d/x",
    "..",
    ".",
    "",
    ".bashrc",
    "a/b",
    "a\\b",
    "a\0b",
    "x\n",
    "CON ",
    "\u202egnp.exe",
    "x" * 256,
    "c:x",
)


def _artifact(name: str, **other: str) -> dict[str, Any]:
    return {
        "id": str(uuid.uuid4()),
        "name": name,
        "size": len(CONTENT),
        "sha256": hashlib.sha256(CONTENT).hexdigest(),
        "media_type": "x",
        **other,
    }


def _rig(*artifacts: dict[str, Any]) -> dict[str, Any]:
    ids = {name: str(uuid.uuid4()) for name in ("id", "subject_id", "job_id", "model_job_id")}
    at = "2026-01-01T00:00:00Z"
    return {
        **ids,
        "name": "Ada",
        "expressions": [],
        "summary": {},
        "artifacts": artifacts,
        "created_at": at,
        "subject": {"id": ids["subject_id"], "name": "Ada"},
    }


def _archive(rig: dict[str, Any], names: dict[str, bytes] | None = None, method: int = 0) -> bytes:
    """Return a rig's ZIP file; ``names`` are the files in it, those that the rig lists if None."""
    listed = {each["name"]: CONTENT for each in rig["artifacts"]}
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", method) as target, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # two of one name
        target.writestr("rig.json", json.dumps(rig))
        for name, content in (listed if names is None else names).items():
            target.writestr(zipfile.ZipInfo(name), content, method)
    return packed.getvalue()


def _part(content: bytes, request: httpx.Request) -> httpx.Response:
    with zipfile.ZipFile(io.BytesIO(content)) as packed:
        tag = hashlib.sha256(packed.read("rig.json")).hexdigest()
    headers = {"ETag": f'"{tag}"', "Content-Length": str(len(content))}
    if request.method == "HEAD":
        return httpx.Response(200, headers=headers)
    first = int(request.headers["Range"].removeprefix("bytes=").removesuffix("-"))
    return httpx.Response(206, content=content[first:], headers={"ETag": headers["ETag"]})


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any], None]:
    """Have every client meet a service that answers this, and any file with the same bytes."""

    def answering(document: Any) -> None:
        def handle(request: httpx.Request) -> httpx.Response:
            if "/artifacts/" in request.url.path:
                return httpx.Response(200, content=CONTENT)
            if request.url.path.endswith("/archive"):
                return _part(_archive(document), request)
            return httpx.Response(200, json=document)

        whole = httpx.Client.__init__

        def init(self: httpx.Client, **given: Any) -> None:
            whole(self, **given | {"transport": httpx.MockTransport(handle)})

        monkeypatch.setattr(httpx.Client, "__init__", init)

    return answering


@pytest.mark.parametrize("name", NAMES, ids=lambda name: repr(name)[:20])
def test_no_file_is_written_by_a_name_that_is_none(
    name: str, answer: Callable[[Any], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "a" / "b" / "c" / "d"
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    answer(_rig(_artifact(name)))
    told = invoke(["rigs", "download", str(uuid.uuid4())])
    assert told.exit_code == 1
    assert "client.answer" in told.stderr
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("names", [("rig.glb", "rig.glb"), ("rig.glb", "RIG.glb"), ("a", "a.")])
def test_two_files_of_one_name_are_refused(
    names: tuple[str, str], answer: Callable[[Any], None]
) -> None:
    answer(_rig(*map(_artifact, names)))
    with Client("http://127.0.0.1:1", "key") as client, pytest.raises(ApiError, match="same name"):
        client.rig(str(uuid.uuid4()))


@pytest.mark.parametrize("name", ["nul", "COM1", "aux.png"])
def test_a_device_of_windows_is_no_file(name: str, answer: Callable[[Any], None]) -> None:
    answer(_rig(_artifact(name)))
    with Client("http://127.0.0.1:1", "key") as client, pytest.raises(ApiError, match="device"):
        client.rig(str(uuid.uuid4()))


@pytest.mark.parametrize("sha256", ["../../x", "", "A" * 64, "0" * 63])
def test_a_digest_that_is_none_names_no_part(sha256: str, answer: Callable[[Any], None]) -> None:
    answer(_rig(_artifact("rig.glb", sha256=sha256)))
    with Client("http://127.0.0.1:1", "key") as client, pytest.raises(ApiError, match="sha256"):
        client.rig(str(uuid.uuid4()))


@pytest.mark.parametrize("name", NAMES, ids=lambda name: repr(name)[:20])
def test_a_capture_names_no_folder_but_a_plain_one(name: str) -> None:
    with pytest.raises(ApiError, match=r"Capture\.name"):
        Capture.read({"id": "x", "name": name, "role": "neutral"})


def test_plain_names_are_fetched(answer: Callable[[Any], None], tmp_path: Path) -> None:
    names = ("rig.glb", "fit_Smile-2.png", "report.html")
    answer(_rig(*map(_artifact, names)))
    told = invoke(["rigs", "download", str(uuid.uuid4()), "--output", str(tmp_path)])
    assert told.exit_code == 0
    assert {path.name for path in tmp_path.iterdir()} == {*names, "rig.json"}


@pytest.mark.parametrize(
    ("names", "method"),
    [
        ({"rig.glb": CONTENT + b"!"}, zipfile.ZIP_STORED),
        ({"rig.glb": CONTENT[::-1]}, zipfile.ZIP_STORED),
        ({"rig.glb": CONTENT}, zipfile.ZIP_DEFLATED),
        ({"other.glb": CONTENT}, zipfile.ZIP_STORED),
    ],
    ids=["another size", "other bytes", "compressed", "another file"],
)
def test_an_archive_that_is_not_as_it_says_leaves_nothing(
    names: dict[str, bytes], method: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = _rig(_artifact("rig.glb"))
    packed = _archive(rig, names, method)
    transport = httpx.MockTransport(lambda request: _part(packed, request))
    with Client("http://127.0.0.1:1", "key") as client:
        client.http = httpx.Client(base_url="http://127.0.0.1:1", transport=transport)
        for fetch in (client.download_rig, client.download_archive):
            with pytest.raises(ApiError, match="arrived damaged"):
                fetch(rig["id"], tmp_path / "rig")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize(
    ("note", "words"),
    [
        (json.dumps(_rig(_artifact("rig.glb"))), "has another rig"),
        ('{"format": "of another program"}', "is of no rig"),
    ],
)
def test_a_rig_is_not_put_over_another_one(
    note: str, words: str, answer: Callable[[Any], None], tmp_path: Path
) -> None:
    answer(_rig(_artifact("rig.glb")))
    files = {"rig.json": note, "rig.glb": "mine"}
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    told = invoke(["rigs", "download", str(uuid.uuid4()), "--output", str(tmp_path)])
    assert told.exit_code == 1
    assert "client.folder" in told.stderr
    assert words in told.stderr
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == files


def test_a_rig_is_not_put_over_files_of_somebody(
    answer: Callable[[Any], None], tmp_path: Path
) -> None:
    answer(_rig(_artifact("rig.glb"), _artifact("rig.usdc")))
    (tmp_path / "rig.usdc").write_text("mine")
    told = invoke(["rigs", "download", str(uuid.uuid4()), "--output", str(tmp_path)])
    assert told.exit_code == 1
    assert "client.folder" in told.stderr
    assert "rig.usdc is another file" in " ".join(told.stderr.split())
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"rig.usdc": "mine"}


@pytest.mark.parametrize(
    ("left", "words"),
    [
        (None, "it has left nothing"),
        (["export.json"], "it has left export.json"),
        (["export.json", "rig.usdc", "more.txt"], ""),
    ],
)
def test_an_export_takes_the_file_of_its_format(
    left: list[str] | None, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = _rig()
    result = None if left is None else {"artifacts": [_artifact(name) for name in left]}
    job = {"id": rig["job_id"], "subject_id": rig["subject_id"], "kind": "export_rig"}
    job |= {"state": "succeeded", "attempt": 1, "result": result, "created_at": rig["created_at"]}

    def handle(request: httpx.Request) -> httpx.Response:
        path = request.url.path
        if "/artifacts/" in path:
            return httpx.Response(200, content=CONTENT)
        if path == "/v1/rigs":
            return httpx.Response(200, json={"items": [rig]})
        return httpx.Response(200, json=rig if "/rigs/" in path else job)

    whole = httpx.Client.__init__
    monkeypatch.setattr(
        httpx.Client,
        "__init__",
        lambda self, **given: whole(self, **given | {"transport": httpx.MockTransport(handle)}),
    )
    told = invoke(["export", rig["id"], "--output", str(tmp_path)])
    assert told.exit_code == (1 if words else 0), told.stderr
    assert words in " ".join(told.stderr.split())
    assert [path.name for path in tmp_path.iterdir()] == ([] if words else ["rig.usdc"])


def test_what_is_beside_the_listed_files_is_not_unpacked(tmp_path: Path) -> None:
    rig = _rig(_artifact("rig.glb"))
    packed = _archive(rig, {"rig.glb": CONTENT, "../x": CONTENT, "y": CONTENT})
    transport = httpx.MockTransport(lambda request: _part(packed, request))
    with Client("http://127.0.0.1:1", "key") as client:
        client.http = httpx.Client(base_url="http://127.0.0.1:1", transport=transport)
        client.download_rig(rig["id"], tmp_path / "rig")
    assert {path.name for path in tmp_path.rglob("*")} == {"rig", "rig.glb", "rig.json"}
