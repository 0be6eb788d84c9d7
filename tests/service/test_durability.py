"""What was acknowledged is on the disk, and not only on its way there."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from sqlalchemy import text

from service.settings import Settings
from service.store.database import Database
from service.store.durable import write_durably
from service.store.files import FolderFiles


class Disk:
    """What has been brought to the disk: the names that a folder had when it was synced."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.folders: dict[Path, set[str]] = {}
        self.files: set[int] = set()
        patch.setattr(os, "fsync", self._sync)

    def _sync(self, descriptor: int) -> None:
        place = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        if place.is_dir():
            self.folders[place] = {path.name for path in place.iterdir()}
        else:
            self.files.add(os.fstat(descriptor).st_ino)

    def has(self, path: Path) -> bool:
        return path.name in self.folders.get(path.parent, set())


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def test_a_commit_waits_for_the_disk(tmp_path: Path) -> None:
    database = Database(Settings(data_dir=tmp_path).database)
    with database.engine.connect() as connection:
        assert connection.execute(text("PRAGMA synchronous")).scalar_one() == 2  # FULL
    database.close()


def test_a_stored_file_is_on_the_disk_with_its_name(tmp_path: Path, disk: Disk) -> None:
    source = tmp_path / "scan.obj"
    source.write_text("v 0 0 0")
    files = FolderFiles(tmp_path / "files")
    sha256 = files.put(source).sha256
    stored = files.path(sha256)
    aside = tmp_path / "files" / "aside" / sha256
    assert stored.stat().st_ino in disk.files
    assert disk.has(stored)
    assert disk.has(stored.parent)
    files.put_aside(sha256)
    assert disk.has(aside)
    assert not disk.has(stored)
    files.take_back(sha256)
    assert disk.has(stored)
    files.put_aside(sha256)
    files.remove(sha256)
    assert not disk.has(aside)
    assert not disk.has(stored)


def test_a_file_that_is_replaced_is_the_old_or_the_new_one(tmp_path: Path, disk: Disk) -> None:
    path = tmp_path / "manifest.json"
    for content in (b"old", b"new"):
        write_durably(path, content)
        assert path.stat().st_ino in disk.files
        assert disk.has(path)
        assert path.read_bytes() == content
    assert [each.name for each in tmp_path.iterdir()] == [path.name]
    assert path.stat().st_mode & 0o777 == 0o600
