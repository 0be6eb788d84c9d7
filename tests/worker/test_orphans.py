"""The sweeper removes what is the service's own, and nothing beside it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from service.store import deletion
from service.store.database import Store
from tests.service_client import eventually
from tests.stores import open_store
from worker.orphans import FOLDER_VARIABLE, note_session, remove_orphans


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(tmp_path) as store:
        yield store


def test_only_folders_of_attempts_are_removed(store: Store, tmp_path: Path) -> None:
    work = tmp_path / "work"
    attempt = work / f"{uuid.uuid4()}.1"
    other = work / "my thesis"
    for folder in (attempt, other):
        folder.mkdir(parents=True)
    remove_orphans(store, work)
    assert [path.name for path in work.iterdir()] == [other.name]


@pytest.mark.skipif(sys.platform != "linux", reason="processes are found on Linux only")
def test_processes_are_found_whatever_they_say_of_themselves(store: Store, tmp_path: Path) -> None:
    """One that was taken over has cleared its environment, and its solver has ended."""
    attempt = tmp_path / "work" / f"{uuid.uuid4()}.1"
    attempt.mkdir(parents=True)
    code = (
        "import subprocess as s; print(s.Popen(['sleep', '600'], env={}).pid, flush=True); input()"
    )
    solver = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
        env={},
    )
    assert solver.stdout is not None
    left = int(solver.stdout.readline())
    note_session(attempt, solver.pid)
    (attempt / "process.json").write_text(json.dumps({"leader": 1}))  # what it writes is not asked
    os.kill(solver.pid, signal.SIGKILL)
    solver.wait()
    try:
        remove_orphans(store, tmp_path / "work")
        eventually(lambda: not Path(f"/proc/{left}/cmdline").exists() or _is_zombie(left))
    finally:
        if Path(f"/proc/{left}").exists():
            os.kill(left, signal.SIGKILL)
    assert list((tmp_path / "work").iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="processes are found on Linux only")
def test_a_process_that_is_not_confined_is_found_in_another_session(
    store: Store, tmp_path: Path
) -> None:
    attempt = tmp_path / "work" / f"{uuid.uuid4()}.1"
    attempt.mkdir(parents=True)
    marks = [{FOLDER_VARIABLE: str(attempt)}, {FOLDER_VARIABLE: f"{attempt}0"}]
    left, other = (
        subprocess.Popen(["sleep", "600"], start_new_session=True, env=mark) for mark in marks
    )
    try:
        remove_orphans(store, attempt.parent)
        assert left.wait(10) == -signal.SIGKILL
        assert other.poll() is None
    finally:
        for process in (left, other):
            process.kill()
            process.wait()


def test_a_note_without_its_folder_goes(store: Store, tmp_path: Path) -> None:
    """A worker died between the removal of the one and of the other."""
    work = tmp_path / "work"
    work.mkdir()
    (work / f"{uuid.uuid4()}.1.session").write_text('{"system": "another"}')
    (work / "mine.session").touch()
    remove_orphans(store, work)
    assert [path.name for path in work.iterdir()] == ["mine.session"]


def _is_zombie(process: int) -> bool:
    return Path(f"/proc/{process}/cmdline").read_bytes() == b""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="processes are found on Linux only")
def test_a_session_whose_number_is_another_one_s_now_is_left_alone(
    store: Store, tmp_path: Path
) -> None:
    attempt = tmp_path / "work" / f"{uuid.uuid4()}.1"
    attempt.mkdir(parents=True)
    other = subprocess.Popen(["sleep", "600"], start_new_session=True)
    try:
        note_session(attempt, other.pid)
        noted = next(attempt.parent.glob("*.session"))
        known = json.loads(noted.read_text())
        for change in ({"started": "1"}, {"system": "another"}):
            attempt.mkdir(exist_ok=True)
            noted.write_text(json.dumps(known | change))
            remove_orphans(store, attempt.parent)
            assert not attempt.exists()
            assert other.poll() is None
    finally:
        other.kill()
        other.wait()


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
