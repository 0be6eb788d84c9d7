"""What a store of files promises, in a folder and in a bucket."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from boto3.s3.transfer import TransferConfig

from service.settings import Settings
from service.store import deletion
from service.store.database import Store
from service.store.files import DamagedFileError, Files, FolderFiles, UnreachableError, files_at, s3
from service.store.models import DEFAULT_TENANT, Template, now
from tests.stores import open_store

pytestmark = pytest.mark.telling

SCAN = os.urandom(1_000_000)
SHA256 = hashlib.sha256(SCAN).hexdigest()
NOBODY = "0" * 64
AT_ONCE = -60.0
"""An age that every file has, also by a clock that is behind."""


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path / "data", broker=Settings().broker) as store:
        yield store


@pytest.fixture
def files(store: Store) -> Files:
    return store.files


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    path = tmp_path / "scan.obj"
    path.write_bytes(SCAN)
    return path


def test_a_file_comes_back_as_it_was(files: Files, scan: Path, tmp_path: Path) -> None:
    assert files.ready()
    assert not files.exists(SHA256)
    assert files.put(scan) == files.put(scan)
    assert files.size(SHA256) == len(SCAN)
    assert [stored.sha256 for stored in files.list_stored()] == [SHA256]
    assert abs(next(files.list_stored()).at - now()) < timedelta(minutes=1)
    for start, end in ((0, None), (0, 1), (999_990, None), (400_000, 700_001), (5, 5)):
        assert b"".join(files.open(SHA256, start, end)) == SCAN[start:end]
    files.fetch(SHA256, tmp_path / "inputs" / "scan.obj")
    assert (tmp_path / "inputs" / "scan.obj").read_bytes() == SCAN
    empty = tmp_path / "empty"
    empty.touch()
    assert files.read(files.put(empty).sha256) == b""


def test_a_large_file_goes_in_parts_and_is_put_aside(
    files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = TransferConfig(multipart_threshold=6 << 20, multipart_chunksize=5 << 20)
    monkeypatch.setattr(s3, "PARTS", small)
    large = tmp_path / "large"
    large.write_bytes(12 * SCAN)
    sha256 = files.put(large).sha256
    files.put_aside(sha256)
    files.fetch(sha256, tmp_path / "aside")
    files.take_back(sha256)
    files.fetch(sha256, tmp_path / "back")
    assert (tmp_path / "back").read_bytes() == large.read_bytes()


def test_a_missing_file_is_known_at_once(files: Files, tmp_path: Path) -> None:
    for ask in (files.open, files.size, files.put_aside):
        with pytest.raises(FileNotFoundError):
            ask(NOBODY)
    with pytest.raises(FileNotFoundError):
        files.fetch(NOBODY, tmp_path / "x")


def test_a_damaged_file_is_not_handed_out(files: Files, scan: Path, tmp_path: Path) -> None:
    files.put(scan)
    damaged = SCAN[:-1] + bytes([SCAN[-1] ^ 1])
    if isinstance(files, FolderFiles):
        files.path(SHA256).unlink()
        files.path(SHA256).write_bytes(damaged)
    else:
        files._client.put_object(Bucket=files._bucket, Key=files._key(SHA256), Body=damaged)
    with pytest.raises(DamagedFileError):
        files.fetch(SHA256, tmp_path / "x")
    assert not (tmp_path / "x").exists()


def test_what_nothing_refers_to_goes_in_two_steps(store: Store, scan: Path) -> None:
    store.files.put(scan)
    assert deletion.collect_garbage(store, 60) == 0
    assert list(store.files.list_stored())
    assert deletion.collect_garbage(store, AT_ONCE) == 0
    assert not list(store.files.list_stored())
    assert store.files.read(SHA256) == SCAN
    assert deletion.collect_garbage(store, 60) == 0
    assert store.files.exists(SHA256)
    assert deletion.collect_garbage(store, AT_ONCE) == 1
    assert not store.files.exists(SHA256)


@pytest.mark.parametrize("stored_again", [False, True])
def test_what_is_wanted_again_stays(store: Store, scan: Path, stored_again: bool) -> None:
    store.files.put(scan)
    deletion.collect_garbage(store, AT_ONCE)
    if stored_again:
        store.files.put(scan)
    template = {"filename": "x", "size": 1, "name": "x", "tenant_id": DEFAULT_TENANT}
    with store.write() as session:
        session.add(Template(sha256=SHA256, **template))
    assert deletion.collect_garbage(store, AT_ONCE) == 0
    assert [stored.sha256 for stored in store.files.list_stored()] == [SHA256]
    assert not list(store.files.list_aside())
    assert store.files.read(SHA256) == SCAN


def test_a_bucket_that_does_not_answer_is_told_from_a_missing_file(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ACCESS_KEY_ID", "x")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "x")
        files = files_at("s3://faces/here?endpoint=http://127.0.0.1:1")
        assert not files.ready()
        with pytest.raises(UnreachableError):
            files.size(NOBODY)
    with pytest.raises(ValueError, match="names no bucket"):
        files_at("s3:///prefix")
