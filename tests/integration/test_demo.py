"""The demonstration as a user runs it: real API, broker, worker and solver, on a coarse mesh."""

from __future__ import annotations

import json
import re
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

TIMEOUT_S = 560


@pytest.mark.slow
@pytest.mark.end_to_end
def test_scans_in_rig_and_report_out(tmp_path: Path) -> None:
    figures_file = tmp_path / "figures.json"
    command = [sys.executable, "-c", "from myoface.cli import main; main()", "demo", "--quick"]
    command += ["--output", str(tmp_path), "--json", str(figures_file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    promises = "watch it on the page http", "training mean", "inverted tets", "report.html"
    for promised in (*promises, "sliders", "myoface up --data"):
        assert promised in done.stdout
    assert re.search(r"fit_geometry: .* \d+%, about ", done.stdout)
    with sqlite3.connect(tmp_path / "service" / "myoface.db") as database:
        jobs = dict(database.execute("SELECT kind, state FROM jobs"))
    assert jobs["build_preview"] == "queued"  # the service that is started next makes them

    figures = json.loads(figures_file.read_text())
    assert figures["glb_faults"] == []
    assert figures["khronos_errors"] in (0, None)
    assert figures["muscles"] >= 40
    assert figures["inverted"] == 0
    # A coarse mesh and two rounds: far from the bars of the whole run, close enough to be a fit.
    assert figures["train_mean_mm"] < 1.5
    assert figures["test_mean_mm"] < 1.5
    assert {fit["role"] for fit in figures["expressions"].values()} == {"train", "test"}
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/jpeg;base64") == len(figures["expressions"])
