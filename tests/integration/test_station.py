"""The example of a capture station, as a process beside a running service."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.service_client import ROOT, Studio, eventually, running


@pytest.fixture
def studio_and_url(tmp_path: Path) -> Iterator[tuple[Studio, str]]:
    with running(tmp_path / "stack") as (stack, studio):
        yield studio, stack.url


@pytest.mark.slow
def test_scans_are_judged_as_they_come(studio_and_url: tuple[Studio, str], tmp_path: Path) -> None:
    studio, url = studio_and_url
    ada, log = tmp_path / "scans" / "Ada", tmp_path / "station.log"
    ada.mkdir(parents=True)
    save(ada / "neutral.obj", "# neutral\n")
    with station(ada.parent, url, studio.key, log) as lines:
        eventually(lambda: "Ada/neutral: good" in lines(), seconds=40)
        save(ada / "smile.obj", "#! verdict bad\n")
        eventually(lambda: "Ada/smile: bad" in lines(), seconds=20)
        assert "towards the lower camera" in log.read_text()
        save(ada / "smile.obj", "# smile, scanned again\n")
        eventually(lambda: "Ada/smile: good" in lines(), seconds=20)
        save(ada / "   .obj", "# x\n")
        eventually(lambda: "refused" in log.read_text(), seconds=20)
    subjects = studio.get("/v1/subjects")["items"]
    assert [subject["name"] for subject in subjects] == ["Ada"]
    captures = f"/v1/subjects/{subjects[0]['id']}/captures"
    before = studio.get(captures)["items"]
    assert {capture["name"] for capture in before} == {"neutral", "smile"}
    with station(ada.parent, url, studio.key, log) as lines:
        eventually(lambda: "Ada/smile: good, as before" in lines(), seconds=40)
    assert studio.get(captures)["items"] == before


@contextmanager
def station(scans: Path, url: str, key: str, log: Path) -> Iterator[Callable[[], list[str]]]:
    """Run the example; yields what returns the lines that it has printed."""
    command = [sys.executable, "docs/examples/station.py", str(scans), "--url", url]
    env = {**os.environ, "PYTHONPATH": str(ROOT), "MYOFACE_API_KEY": key}
    with log.open("w") as stream:
        child = subprocess.Popen(command, cwd=ROOT, env=env, stdout=stream, stderr=stream)
    try:
        yield lambda: log.read_text().splitlines()
    finally:
        child.terminate()
        child.wait(10)


def save(path: Path, text: str) -> None:
    """Leave a file as if it had been saved a while ago."""
    unfinished = path.with_suffix(".part")
    unfinished.write_text(text)
    then = unfinished.stat().st_mtime - 60
    os.utime(unfinished, (then, then))
    unfinished.rename(path)
