"""Places that are this user's or this installation's alone."""

from __future__ import annotations

import uuid
from pathlib import Path

import pytest

from myoface.doctor import machine
from service.settings import LONGEST_SOCKET_PATH, Settings
from service.store.broker import BrokerNotFoundError, EmbeddedBroker
from service.store.database import Store
from worker.orphans import remove_orphans


@pytest.fixture
def far(tmp_path: Path) -> Settings:
    """Settings whose data folder has too long a path for a socket in it."""
    return Settings(data_dir=tmp_path / ("x" * LONGEST_SOCKET_PATH))


def test_a_socket_that_does_not_fit_is_in_a_folder_of_this_user(
    far: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", "/home/ada")
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    assert far.broker_socket.parent == Path("/home/ada/.local/state/myoface")
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/1000")
    assert far.broker_socket.parent == Path("/run/user/1000/myoface")


def test_no_broker_listens_where_another_user_could(
    far: Settings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    open_to_all = tmp_path / "open"
    open_to_all.mkdir()
    open_to_all.chmod(0o777)
    broker = EmbeddedBroker(tmp_path / "broker", open_to_all / "valkey.sock")
    with pytest.raises(BrokerNotFoundError, match="not this user's alone"):
        broker.start()
    own = tmp_path / "own"
    broker = EmbeddedBroker(tmp_path / "broker", own / "valkey.sock")
    monkeypatch.setattr("os.geteuid", lambda: 12345)
    with pytest.raises(BrokerNotFoundError, match="not this user's alone"):
        broker.start()
    assert own.stat().st_mode & 0o077 == 0


def test_the_doctor_warns_of_folders_that_others_can_look_into(tmp_path: Path) -> None:
    narrow = tmp_path / "narrow"
    wide = tmp_path / "wide open"
    narrow.mkdir(mode=0o700)
    assert machine.access(narrow, tmp_path / "missing").verdict == "ok"
    wide.mkdir()
    wide.chmod(0o750)
    found = machine.access(narrow, wide)
    assert found.verdict == "warning"
    assert str(wide) in found.found
    assert str(narrow) not in found.found
    assert found.advice == f"chmod -R go= '{wide}'"


@pytest.mark.long
def test_two_installations_with_one_work_folder_keep_their_attempts(tmp_path: Path) -> None:
    work = tmp_path / "work"
    stores = []
    for name in ("north", "south"):
        settings = Settings(data_dir=tmp_path / name, work_dir=work)
        store = Store(settings.database, settings.files, settings.broker)
        store.database.migrate()
        stores.append((store, settings))
        (settings.work / f"{uuid.uuid4()}.1").mkdir(parents=True)
    (north, of_north), (south, of_south) = stores
    remove_orphans(north, of_north.work)
    assert list(of_north.work.iterdir()) == []
    assert len(list(of_south.work.iterdir())) == 1
    for store in (north, south):
        store.close()


def test_the_work_folder_is_the_same_whatever_the_password() -> None:
    places = {
        Settings(database_url=f"postgresql://me:{password}@host/db").work
        for password in ("one", "two")
    }
    assert len(places) == 1
