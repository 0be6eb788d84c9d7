"""Backup and restore of a service with something in it, whatever is wrong on either side."""

from __future__ import annotations

import fcntl
import json
import resource
import signal
from pathlib import Path

import pytest
from sqlalchemy import inspect, select, text

from myoface.backup import back_up, note_deletions, restore, verify
from myoface.backup.folder import DELETIONS, MANIFEST
from myoface.errors import StackError
from service.settings import Settings
from service.store.database import UNFINISHED, Database, Store, UnfinishedRestoreError
from service.store.models import Capture, Subject
from tests.command_line import invoke
from tests.servers.production import Production
from tests.service_client import served


@pytest.fixture
def fresh(parts: Production | None, tmp_path: Path) -> Settings:
    """Settings of a service that has nothing, on parts of its own."""
    own = (
        {key.removeprefix("MYOFACE_").lower(): value for key, value in parts.fresh().items()}
        if (parts)
        else {}
    )
    return Settings(data_dir=tmp_path / "fresh", **own)


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "old")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "backup"


def _store(settings: Settings) -> Store:
    return Store(settings.database, settings.files, settings.broker)


def _tables(settings: Settings) -> list[str]:
    database = Database(settings.database)
    found = inspect(database.engine).get_table_names()
    database.close()
    return found


def _subjects(settings: Settings) -> set[str]:
    with _store(settings).read() as session:
        return set(session.scalars(select(Subject.id)))


def _scan(settings: Settings, sha256: str) -> Path:
    return settings.data_dir / "files" / sha256[:2] / sha256


def _only_folder(settings: Settings) -> None:
    if isinstance(settings.files, str):
        pytest.skip("files are damaged in a folder here")


def _overwrite(path: Path, content: bytes) -> None:
    path.chmod(0o600)
    path.write_bytes(content)


def test_a_backup_brings_everything_back_but_not_the_deleted(
    settings: Settings, folder: Path, fresh: Settings
) -> None:
    with served(settings) as studio:
        key = studio.key
        kept = studio.subject()
        gone = studio.post("/v1/subjects", name="Bo")["id"]
        smile = studio.capture(gone, "smile")
        job = studio.submit("build_model", kept)
        first = back_up(settings, folder)
        assert len(first.files) == 2
        assert not first.missing
        studio.http.delete(f"/v1/subjects/{gone}")
        assert note_deletions(settings, folder) == 1
    scans = {path.name for path in (folder / "files").glob("??/*")}
    assert scans == set(first.files)
    assert verify(folder)[0] == first
    assert restore(fresh, folder) == (first, 1)
    fresh.admin_key.write_text(key)
    with served(fresh) as studio:
        assert studio.get(f"/v1/subjects/{kept}")["name"] == "Alex"
        assert studio.job(job)["state"] == "queued"
        assert studio.http.get(f"/v1/subjects/{gone}").status_code == 404
        assert studio.http.get(f"/v1/subjects/{gone}/captures/{smile}").status_code == 404
    store = _store(fresh)
    assert all(store.files.exists(sha256) for sha256 in first.files)
    with pytest.raises(StackError, match="tables already"):
        restore(fresh, folder)


def test_a_damaged_backup_changes_nothing(
    settings: Settings, folder: Path, fresh: Settings, tmp_path: Path
) -> None:
    with served(settings) as studio:
        studio.subject()
        manifest = back_up(settings, folder)
    [scan] = (folder / "files").glob("??/*")
    whole = scan.read_bytes()
    _overwrite(scan, whole + b"x")
    for attempt in (lambda: restore(fresh, folder), lambda: verify(folder)):
        with pytest.raises(StackError, match="is damaged"):
            attempt()
    _overwrite(scan, whole)
    dump = folder / manifest.dump
    content = dump.read_bytes()
    dump.write_bytes(content + b"x")
    with pytest.raises(StackError, match="damaged or lost"):
        restore(fresh, folder)
    dump.write_bytes(content)
    deletions = (folder / DELETIONS).read_text()
    for spoilt in ("", "[{", '[{"kind": 1}]'):
        (folder / DELETIONS).write_text(spoilt)
        with pytest.raises(StackError, match="deleted people would come back"):
            restore(fresh, folder)
    (folder / DELETIONS).unlink()
    with pytest.raises(StackError, match="deleted people would come back"):
        restore(fresh, folder)
    (folder / DELETIONS).write_text(deletions)
    with pytest.raises(StackError, match="no whole backup"):
        restore(fresh, tmp_path)
    assert _tables(fresh) == []
    assert not list(_store(fresh).files.list_stored())
    assert restore(fresh, folder)[0] == manifest


def test_a_backup_of_a_newer_release_changes_nothing_and_names_it(
    settings: Settings, folder: Path, fresh: Settings
) -> None:
    with served(settings) as studio:
        studio.subject()
    store = _store(settings)
    with store.write() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    manifest = back_up(settings, folder)
    path = folder / MANIFEST
    path.write_text(path.read_text().replace(f'"{manifest.release}"', '"9.9.9"'))
    with pytest.raises(StackError, match=r"release 9\.9\.9 \(revision 9999\), newer than this one"):
        restore(fresh, folder)
    document = json.loads(path.read_text())
    del document["revision"]  # as release 0.1.0 wrote it: the dump says it
    path.write_text(json.dumps(document))
    with pytest.raises(StackError, match="revision 9999"):
        restore(fresh, folder)
    assert _tables(fresh) == []
    assert not (fresh.data_dir / "secret").exists()


def test_a_backup_of_the_first_release_can_be_restored_and_gone_on_with(
    settings: Settings, folder: Path, fresh: Settings
) -> None:
    with served(settings) as studio:
        subject = studio.subject()
        manifest = back_up(settings, folder)
        old = "database.sqlite" if manifest.database == "sqlite" else "database.dump"
        (folder / manifest.dump).rename(folder / old)
        document = json.loads((folder / MANIFEST).read_text())
        for name in ("dump", "revision", "release"):
            del document[name]
        (folder / MANIFEST).write_text(json.dumps(document | {"missing": []}))
        assert restore(fresh, folder)[0].dump == old
        second = back_up(settings, folder)
    assert sorted(path.name for path in folder.glob("database.*")) == [second.dump]
    assert _subjects(fresh) == {subject}


def test_a_later_backup_forgets_what_was_deleted(settings: Settings, folder: Path) -> None:
    with served(settings) as studio:
        subject = studio.subject()
        assert len(back_up(settings, folder).files) == 1
        studio.http.delete(f"/v1/subjects/{subject}")
        assert back_up(settings, folder).files == []
    assert not list((folder / "files").glob("??/*"))
    assert not list((folder / "files" / "aside").iterdir())
    [deleted] = json.loads((folder / DELETIONS).read_text())
    assert deleted["object_id"] == subject


def test_as_many_backups_stay_as_are_to_be_kept(
    settings: Settings, folder: Path, fresh: Settings
) -> None:
    with served(settings) as studio:
        subject = studio.subject()
        made = [back_up(settings, folder, keep=2)]
        studio.http.delete(f"/v1/subjects/{subject}")
        other = studio.subject(weight=2)
        made += [back_up(settings, folder, keep=2) for _ in range(2)]
    assert {path.name for path in folder.glob("database.*")} == {each.dump for each in made[1:]}
    assert {path.name for path in (folder / "files").glob("??/*")} == set(made[1].files)
    with pytest.raises(StackError, match=f"it has {made[1].stamp}, {made[2].stamp}"):
        restore(fresh, folder, "yesterday")
    assert restore(fresh, folder, made[1].stamp)[0] == made[1]
    assert _subjects(fresh) == {other}


def test_lost_and_damaged_files_are_named_and_stepped_over(
    settings: Settings, folder: Path, fresh: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    _only_folder(settings)
    with served(settings) as studio:
        subject = studio.subject()
        smile = studio.capture(subject, "smile")
        frown = studio.capture(subject, "frown")
        scans = {
            each["name"]: each["sha256"]
            for each in studio.get(f"/v1/subjects/{subject}/captures")["items"]
        }
    _overwrite(_scan(settings, scans["smile"]), b"rot")
    _scan(settings, scans["frown"]).unlink()
    manifest = back_up(settings, folder)
    assert manifest.files == [scans["neutral"]]
    assert {(each.sha256, each.fault, *each.belongs_to[:1]) for each in manifest.missing} == {
        (scans["smile"], "damaged", f"capture smile of subject {subject}"),
        (scans["frown"], "lost", f"capture frown of subject {subject}"),
    }
    told = invoke(["backup", str(folder), "--data", str(settings.data_dir), "--verify"])
    assert told.exit_code == 1
    assert "verified" in told.stdout
    assert f"damaged in the service: capture smile of subject {subject}" in told.stdout
    restore(fresh, folder)
    with _store(fresh).read() as session:
        assert {smile, frown} < set(session.scalars(select(Capture.id)))


def test_what_the_service_lost_since_stays_in_the_backup(settings: Settings, folder: Path) -> None:
    _only_folder(settings)
    with served(settings) as studio:
        studio.subject()
    [sha256] = back_up(settings, folder).files
    _overwrite(_scan(settings, sha256), b"rot")
    assert back_up(settings, folder).files == [sha256]
    _scan(settings, sha256).unlink()
    assert back_up(settings, folder, reread=True).files == [sha256]
    verify(folder)


def test_a_file_damaged_in_the_backup_is_copied_again(settings: Settings, folder: Path) -> None:
    with served(settings) as studio:
        studio.subject()
    back_up(settings, folder)
    [kept] = (folder / "files").glob("??/*")
    _overwrite(kept, b"rot")
    back_up(settings, folder)
    with pytest.raises(StackError, match="is damaged"):
        verify(folder)
    back_up(settings, folder, reread=True)
    verify(folder)


def test_a_database_that_cannot_be_dumped_leaves_the_backup_before(
    settings: Settings, folder: Path, fresh: Settings
) -> None:
    database = Database(settings.database)
    if not database.is_sqlite:
        pytest.skip("pg_dump finds this by itself")
    with served(settings) as studio:
        subject = studio.subject()
    first = back_up(settings, folder)
    path = Path(str(database.url.database))
    content = path.read_bytes()
    spoilt = bytearray(content)
    spoilt[4096 * 3 : 4096 * 12] = b"\xff" * 4096 * 9
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, limits[1]))
        with pytest.raises(StackError, match="there is no new backup"):
            back_up(settings, folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    path.write_bytes(spoilt)
    with pytest.raises(StackError, match="there is no new backup"):
        back_up(settings, folder)
    path.unlink()
    with pytest.raises(StackError, match="is --data the service's folder"):
        back_up(settings, folder)
    assert not path.exists()
    assert [each.name for each in folder.glob("database.*")] == [first.dump]
    restore(fresh, folder)
    assert _subjects(fresh) == {subject}


def test_a_restore_that_was_interrupted_can_be_done_again(
    settings: Settings, folder: Path, fresh: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    with served(settings) as studio:
        gone = studio.subject()
        manifest = back_up(settings, folder)
        studio.http.delete(f"/v1/subjects/{gone}")
        note_deletions(settings, folder)

    def stop(*_: object) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as interrupted:
        interrupted.setattr("myoface.backup.restoration._repeat", stop)
        with pytest.raises(KeyboardInterrupt):
            restore(fresh, folder)
    if _tables(fresh):  # PostgreSQL's: nobody is shown what comes back until it is deleted again
        with pytest.raises(UnfinishedRestoreError, match="run `myoface restore` again"):
            Database(fresh.database).refuse_unfinished()
    assert restore(fresh, folder) == (manifest, 1)
    assert UNFINISHED not in _tables(fresh)
    assert _subjects(fresh) == set()


def test_two_backups_at_a_time_are_refused(settings: Settings, folder: Path) -> None:
    with served(settings) as studio:
        studio.subject()
    folder.mkdir()
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(StackError, match="at work"):
            back_up(settings, folder)


def test_the_commands_take_the_data_folder(
    settings: Settings, folder: Path, fresh: Settings
) -> None:
    with served(settings) as studio:
        subject = studio.subject()
    old = ["--data", str(settings.data_dir)]
    new = ["--data", str(fresh.data_dir)]
    for command in (
        ["backup", str(folder), *old, "--keep", "2", "--verify"],
        ["backup", str(folder), *old, "--deletions"],
        ["restore", str(folder), "--verify"],
    ):
        told = invoke(command)
        assert told.exit_code == 0, told.output
    if Database(settings.database).is_sqlite:
        told = invoke(["restore", str(folder), *new])
        assert told.exit_code == 0, told.output
        assert _subjects(fresh) == {subject}
