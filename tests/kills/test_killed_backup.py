"""A backup that is killed, or finds the disk full, at any step leaves one that can be restored."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from myoface.backup import back_up
from service.settings import Settings
from tests.kills.backup_drill import ENDED, REFUSED
from tests.service_client import served

# The backup before, the same with Bo's deletion noted, and the new one
ALLOWED = (["Alex", "Bo"], ["Alex"], ["Alex", "Cy"])


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A service's data and its backup, since which much has changed."""
    data = tmp_path_factory.mktemp("data")
    backup = tmp_path_factory.mktemp("backup")
    settings = Settings(data_dir=data)
    with served(settings) as studio:
        stays = studio.subject(weight=1)
        gone = studio.post("/v1/subjects", name="Bo")["id"]
        studio.capture(gone, "smile")
        back_up(settings, backup)
        studio.post("/v1/subjects", name="Cy")
        studio.http.delete(f"/v1/subjects/{gone}")
        studio.capture(stays, "frown")
    return data, backup


def _drill(blow: str, places: tuple[Path, Path], scratch: Path) -> Iterator[dict[str, Any]]:
    command = [sys.executable, "-m", "tests.kills.backup_drill", blow, *map(str, places), scratch]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return map(json.loads, done.stdout.splitlines())


@pytest.mark.parametrize(("blow", "least"), [("kill", 60), ("full", 20)])
def test_the_last_good_backup_can_be_restored_whatever_the_step(
    blow: str, least: int, places: tuple[Path, Path], tmp_path: Path
) -> None:
    *steps, last = _drill(blow, places, tmp_path)
    assert len(steps) >= least
    assert last["code"] == ENDED
    assert last["subjects"] == ["Alex", "Cy"]
    for step in steps:
        assert step.get("whole"), step
        assert step["subjects"] in ALLOWED, step
        if blow == "full":
            assert step["code"] == REFUSED, step
