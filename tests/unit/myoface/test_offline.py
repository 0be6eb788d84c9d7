"""The commands that solve in this process."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from myoface.cli import app
from solver.errors import InputError


@pytest.mark.parametrize("existed", [False, True])
def test_a_refused_scan_leaves_no_empty_folder(existed: bool, tmp_path: Path) -> None:
    scan, folder = tmp_path / "neutral.obj", tmp_path / "model"
    scan.write_text("v 0 0 nan\n")
    if existed:
        folder.mkdir()
    done = CliRunner().invoke(app, ["solve", "build-model", str(scan), "-o", str(folder)])
    assert isinstance(done.exception, InputError)
    assert folder.exists() == existed
