"""The sweeper removes what is the service's own, and nothing beside it."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.store import deletion
from service.store.database import Store
from worker.process import remove_orphans


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = Store(f"sqlite:///{tmp_path / 'db'}", tmp_path / "files", "redis://localhost:1/0")
    store.database.migrate()
    yield store
    store.close()


def test_only_folders_of_attempts_are_removed(store: Store, tmp_path: Path) -> None:
    work = tmp_path / "work"
    attempt, other = work / f"{uuid.uuid4()}.1", work / "my thesis"
    for folder in (attempt, other):
        folder.mkdir(parents=True)
    remove_orphans(store, work)
    assert [path.name for path in work.iterdir()] == [other.name]


def test_only_stored_files_are_collected(store: Store, tmp_path: Path) -> None:
    source = tmp_path / "scan.obj"
    source.write_text("v 0 0 0")
    sha256 = store.files.put(source).sha256
    other = store.files.root / "my" / "thesis.txt"
    other.parent.mkdir()
    other.write_text("not ours")
    for path in (store.files.path(sha256), other):
        os.utime(path, (0, 0))
    assert deletion.collect_garbage(store, 60) == 0
    assert store.files.read(sha256) == b"v 0 0 0"  # put aside, for the next look into the tables
    assert deletion.collect_garbage(store, 60) == 0
    os.utime(store.files.root / "aside" / sha256, (0, 0))
    assert deletion.collect_garbage(store, 60) == 1
    assert (store.files.exists(sha256), other.exists()) == (False, True)
