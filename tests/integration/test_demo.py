"""The demonstration as a user runs it: real API, broker, worker and solver, on a coarse mesh."""

from __future__ import annotations

import json
import re
import shlex
import signal
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

from myoface.cli.demo import QUICK_OPTIONS
from myoface.stack import free_port
from solver.anatomy.meshing import find_or_make_mesh
from solver.templates.builtin.build import builtin_template
from tests.browser.rig_place import drawing_browser, until
from tests.servers.production import Production

TIMEOUT_S = 560
SHOWN_S = 120.0
PROGRAM = [sys.executable, "-c", "from myoface.cli import main; main()"]


@pytest.mark.slow
@pytest.mark.end_to_end
def test_scans_in_rig_and_report_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, parts: Production | None
) -> None:
    """At its end the rig is opened in the browser, as the demonstration's last lines say."""
    monkeypatch.setenv("MYOFACE_PORT", str(free_port("127.0.0.1")))
    # half a minute's work of a processor, which the cache keeps from run to run
    find_or_make_mesh(builtin_template(), QUICK_OPTIONS["build_model"]["edge_mm"])
    figures_file = tmp_path / "figures.json"
    command = [*PROGRAM, "demo", "--quick", "--output", str(tmp_path), "--json", str(figures_file)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    promises = "watch it on the page http", "training mean", "inverted tets", "report.html"
    for promised in (*promises, "sliders", "myoface up --data"):
        assert promised in done.stdout
    assert re.search(r"fit_geometry: .* \d+%, about ", done.stdout)
    if parts is None:
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

    up, url = re.findall(r"in the browser myoface (.*)\n +and open (\S+)", done.stdout)[0]
    key = (tmp_path / "service" / "admin.key").read_text()
    with subprocess.Popen([*PROGRAM, *shlex.split(up)], stdout=subprocess.PIPE, text=True) as stack:
        try:
            assert stack.stdout
            assert "listens on" in stack.stdout.readline()
            with drawing_browser() as browser:
                page = browser.new_page()
                page.goto(f"{url}#key={key}")
                shown = "performance.getEntriesByName('rig-shown').length"
                # asked anew each time: the page's policy refuses a script that waits by itself
                until(lambda: page.evaluate(shown) > 0, SHOWN_S)
        finally:
            stack.send_signal(signal.SIGTERM)
