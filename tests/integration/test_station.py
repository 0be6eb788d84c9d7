"""The example of a capture station, as a process beside a running service."""

from __future__ import annotations

import os
import shutil
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
    ada = tmp_path / "scans" / "Ada"
    log = tmp_path / "station.log"
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


@pytest.mark.slow
def test_the_station_in_c_sharp_does_the_same(
    studio_and_url: tuple[Studio, str], tmp_path: Path
) -> None:
    mcs = shutil.which("mcs")
    mono = shutil.which("mono")
    if mcs is None or mono is None:
        pytest.skip("there is no C# (apt-get install mono-mcs mono-runtime libmono-cil-dev)")
    studio, url = studio_and_url
    program = tmp_path / "station.exe"
    names = ("System.Net.Http", "System.Runtime.Serialization", "System.Xml", "System.Xml.Linq")
    references = [f"-r:{name}.dll" for name in names]
    source = ROOT / "docs" / "examples" / "station.cs"
    subprocess.run([mcs, "-langversion:5", f"-out:{program}", *references, source], check=True)
    ada = tmp_path / "scans" / "Ada"
    ada.mkdir(parents=True)
    save(ada / "AdaNeutral.obj", "# neutral\n")
    save(ada / "Großes Lächeln.obj", "#! verdict bad\n")
    refused = (
        "   .obj",
        "Ærger.obj",
        "aerger.ply",
        "nul.obj",
        "(com1).obj",
        "kiss..obj",
        "Kiss.obj",
    )
    for name in refused:
        save(ada / name, "# x\n")

    def look(*options: str) -> str:
        command = [mono, str(program), str(ada.parent), *options, url, "--once"]
        env = {**os.environ, "MYOFACE_API_KEY": studio.key}
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
        return done.stdout

    told = look()
    assert "AdaNeutral.obj: good" in told
    assert "towards the lower camera" in told
    assert "   .obj: refused: no name can be made of it" in told
    assert "aerger.ply: refused: it and Ærger.obj would both be called aerger" in told
    assert "kiss..obj: refused: it and Kiss.obj would both be called kiss" in told
    assert "nul.obj: refused: this is a device's name on Windows" in told
    for name in refused:
        assert f"{name}: refused: " in told
    (subject,) = studio.get("/v1/subjects")["items"]
    path = f"/v1/subjects/{subject['id']}/captures"
    before = {each["name"]: each for each in studio.get(path)["items"]}
    assert {name: each["role"] for name, each in before.items()} == {
        "AdaNeutral": "neutral",
        "Grosses_Lacheln": "expression",
    }
    save(ada / "Großes Lächeln.obj", "# scanned again\n")
    assert "Lächeln.obj: good" in look("--unit", "22.9")
    checks = [studio.job(each["id"]) for each in studio.get("/v1/jobs?kind=check_scan")["items"]]
    assert 22.9 in [each["options"].get("unit") for each in checks]
    assert "Lächeln.obj: good" in look("--eye-distance", "62")
    newest = studio.job(studio.get("/v1/jobs?kind=check_scan")["items"][0]["id"])
    assert newest["options"]["eye_distance_mm"] == 62
    after = {each["name"]: each["id"] for each in studio.get(path)["items"]}
    assert set(after) == set(before)
    assert after["AdaNeutral"] == before["AdaNeutral"]["id"]  # the same bytes: not sent again
    assert after["Grosses_Lacheln"] != before["Grosses_Lacheln"]["id"]


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
