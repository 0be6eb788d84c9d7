"""Every benchmark, as a person runs it with `--quick`: from its command line to its figures."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks import subjects
from tests.fixtures import data_folder

ROOT = Path(__file__).parents[2]
NONE = Path("/nonexistent")  # where no data is: benchmarks run on the built-in person
SECONDS = 1800


def folders() -> list[str]:
    """Return the options of a template and faces of the data."""
    anatomy = data_folder("bodyparts3d")
    faces = data_folder("ict_facekit")
    return ["--anatomy", str(anatomy), "--faces", str(faces)]


def data() -> list[str]:
    """Return the option of the whole data."""
    return ["--data", str(data_folder())]


def by_default() -> list[str]:
    """Ask for the data, which the benchmark takes by itself."""
    data_folder("performance")
    return []


def no_peer() -> list[str]:
    """Leave out the peer, whose package of 2 GB is installed for nobody unasked."""
    return ["--python", str(NONE)]


def take() -> list[str]:
    """Ask for a fitted take."""
    pytest.skip("it needs a rig and a fitted take of its person: see --rig and --sequence")


# What a benchmark needs beside --quick; those without anything run on the built-in person.
NEEDS: dict[str, Callable[[], list[str]] | None] = {
    "anatomy": folders,
    "check_service": None,
    "controls": None,
    "convergence": None,
    "fibres": by_default,
    "film": None,
    "fit_quality": None,
    "fit_speed": None,
    "information": None,
    "ingest": None,
    "live": by_default,
    "marker_check": None,
    "markers": by_default,
    "neck": None,
    "neck_skin": None,
    "odd_units": None,
    "openface": None,
    "peers": no_peer,
    "photo": None,
    "physics": None,
    "plausibility": None,
    "preview": None,
    "prime_movers": None,
    "rebase": data,
    "reference": None,
    "registration": data,
    "round_trip": None,
    "round_trip_faces": None,
    "single_muscles": None,
    "studio_rig": None,
    "systems": None,
    "take_scenes": take,
    "tracks": None,
    "transfer": None,
}


def test_every_benchmark_is_run_here() -> None:
    found = {
        file.parent.name if file.stem == "__main__" else file.stem
        for file in (ROOT / "benchmarks").rglob("*.py")
        if re.search(r"^    parser = report\.parser\(", file.read_text(), re.M)
    }
    assert found == NEEDS.keys()


def test_the_built_in_person_is_asked_for_as_any_other() -> None:
    options = subjects.builtin_options()
    assert options.faces is None
    assert not options.whole
    source = (ROOT / "benchmarks" / "subjects.py").read_text()
    assert set(re.findall(r"\boptions\.(\w+)", source)) - {"controls"} <= vars(options).keys()


@pytest.mark.slow
@pytest.mark.parametrize("name", NEEDS)
def test_a_quick_run_ends_with_its_figures(name: str, tmp_path: Path) -> None:
    needs = NEEDS[name]
    file = tmp_path / "figures.json"
    more = [] if needs is None else needs()
    command = [sys.executable, "-m", f"benchmarks.{name}", "--quick", "--json", str(file), *more]
    where = os.environ | ({"MYOFACE_DATA": str(NONE)} if needs is None else {})
    path = f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env=where | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=SECONDS,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(file.read_text())
    assert figures["run"]["benchmark"] == name
    assert len(figures) > 2
