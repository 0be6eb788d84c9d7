"""The client, the command line and the station without the modules that Windows does not have."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.service_client import ROOT, Studio, running

# What Python has on Linux and not on Windows; os and signal lose what they have there alone.
AS_ON_WINDOWS = """
import importlib.abc
import os
import pathlib
import signal
import sys

MISSING = {"fcntl", "pwd", "grp", "resource", "termios", "tty", "pty", "syslog", "crypt", "spwd"}
OURS = {"service", "worker", "solver", "pydantic", "typer", "click", "rich", "numpy"}

class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in MISSING | OURS:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Blocker())
for name in MISSING:
    sys.modules.pop(name, None)
for name in ("fork", "forkpty", "getuid", "geteuid", "getgid", "chown", "fchown", "fchmod",
             "mkfifo", "setsid", "killpg", "getpgid", "statvfs", "uname", "nice", "sync"):
    delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "SIGUSR1", "SIGALRM", "alarm", "setitimer", "pause"):
    delattr(signal, name)
"""
COMMAND = "import sys\nfrom myoface.cli import main\nsys.argv[0] = 'myoface'\nmain()"
STATION = """
import runpy
runpy.run_path("docs/examples/station.py", run_name="__main__")
"""
AWAITED = """
import asyncio
from myoface.client import AsyncClient
async def main():
    async with AsyncClient(sys.argv[1]) as client:
        print(*(ascii(each.name) for each in await client.subjects()))
asyncio.run(main())
"""

Python = Callable[..., str]


@pytest.fixture(scope="module")
def studio_and_url(
    parts: object, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Studio, str]]:
    with running(tmp_path_factory.mktemp("stack")) as (stack, studio):
        yield studio, stack.url


@pytest.fixture
def python(studio_and_url: tuple[Studio, str], tmp_path: Path) -> Python:
    studio, url = studio_and_url
    env = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "PYTHONIOENCODING": "cp1252",
        "MYOFACE_API_KEY": studio.key,
        "MYOFACE_URL": url,
        "MYOFACE_CACHE": str(tmp_path / "cache"),
    }

    def run(code: str, *words: str | Path, exit_code: int = 0) -> str:
        command = [sys.executable, "-c", AS_ON_WINDOWS + code, *map(str, words)]
        done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, check=False)
        told = (done.stdout + done.stderr).decode("cp1252")
        assert done.returncode == exit_code, told
        return told

    return run


def save(path: Path, *orders: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join([f"# {path.stem}", *(f"#! {order}" for order in orders)]), "utf-8")
    then = path.stat().st_mtime - 60
    os.utime(path, (then, then))
    return path


@pytest.mark.slow
def test_a_session_at_a_windows_machine(
    python: Python, studio_and_url: tuple[Studio, str], tmp_path: Path
) -> None:
    def myoface(*words: str | Path, exit_code: int = 0) -> str:
        return python(COMMAND, *words, exit_code=exit_code)

    myoface("subjects", "add", "Zoë 微笑")
    neutral = save(tmp_path / "James Neutral 01.obj")
    smile = save(tmp_path / "James Lächeln 02.obj")
    told = myoface("captures", "add", "zoë 微笑", neutral, smile, "--check")
    assert "Neutral_01  neutral" in told
    assert "Lacheln_02: good" in told
    bad = save(tmp_path / "blink.obj", "verdict bad")
    assert "bad" in myoface("captures", "add", "Zoë 微笑", bad, "--check", exit_code=3)

    told = myoface("batches", "add", neutral, smile, "--person", "James")
    assert "succeeded" in told
    rig = told.split()[-1]
    for _ in range(2):
        myoface("rigs", "download", rig[:8], "-o", tmp_path / "rig")
    note = json.loads((tmp_path / "rig" / "rig.json").read_text("utf-8"))
    assert note["id"] == rig
    assert note["subject"]["name"] == "James"
    for file in note["artifacts"]:
        assert (tmp_path / "rig" / file["name"]).stat().st_size == file["size"]
    assert "James" in python(AWAITED, studio_and_url[1])
    assert "`myoface up` needs Linux" in myoface("up", exit_code=1)
    assert "Run the service" in myoface("--help")


@pytest.mark.slow
def test_the_station_at_a_windows_machine(
    python: Python, studio_and_url: tuple[Studio, str], tmp_path: Path
) -> None:
    studio, url = studio_and_url
    folder = tmp_path / "scans" / "Grace"
    folder.parent.mkdir()
    save(folder / "Grace Neutral.obj")
    save(folder / "ein Lächeln.obj")
    save(folder / "smile 1.obj")
    save(folder / "smile_1.obj")
    save(folder / "   .obj")
    told = python(STATION, folder.parent, "--url", url, "--once").splitlines()
    assert "Grace/Grace Neutral: good" in told
    assert "Grace/ein Lächeln: good" in told
    assert len([line for line in told if "would both be called smile_1" in line]) == 2
    assert len([line for line in told if "no name can be made of" in line]) == 1
    (subject,) = [each for each in studio.get("/v1/subjects")["items"] if each["name"] == "Grace"]
    found = studio.get(f"/v1/subjects/{subject['id']}/captures")["items"]
    assert {(each["name"], each["role"], each["filename"]) for each in found} == {
        ("Grace_Neutral", "neutral", "Grace Neutral.obj"),
        ("ein_Lacheln", "expression", "ein Lächeln.obj"),
    }
