"""Solver processes that wait for a check with their code loaded."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from structlog.testing import capture_logs

from service.settings import Settings
from tests.service_client import eventually
from worker import sandbox, solve
from worker.process import MOST_FAILURES, SolverProcess, Standby, _Interpreter

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="they are Linux's")

# What a check imports beside what was loaded ahead
CHECKED = """
import importlib, sys
from worker.solve import AHEAD
for name in AHEAD:
    importlib.import_module(name)
ahead = set(sys.modules)
import solver.jobs.check_scan
print(*sorted(ahead))
print(*sorted(set(sys.modules) - ahead))
"""


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path, jobs="tests.standin.jobs")


@pytest.fixture
def standby(settings: Settings) -> Iterator[Standby]:
    standby = Standby(settings, 1)
    yield standby
    standby.stop()


def _process(folder: Path, settings: Settings, standby: Standby) -> SolverProcess:
    folder.mkdir()
    (folder / "job.json").write_text("{}")
    return SolverProcess(folder, settings, "tenant", 60.0, standby)


def _ready(standby: Standby) -> _Interpreter:
    """Return the one process that waits, when it does."""
    standby.fill()
    [waiting] = standby._waiting
    eventually(waiting.is_ready, seconds=60)
    return waiting


def test_what_is_loaded_ahead_is_most_of_a_check_and_has_no_kernels() -> None:
    done = subprocess.run([sys.executable, "-c", CHECKED], capture_output=True, text=True)
    ahead, later = (line.split() for line in done.stdout.splitlines())
    own = [importlib.util.find_spec(name) for name in ahead if name.startswith("solver.")]
    origins = [spec.origin for spec in own if spec and spec.origin]
    assert origins
    assert not [origin for origin in origins if "njit" in Path(origin).read_text()]
    assert len([name for name in later if not name.startswith("solver")]) < len(ahead) / 20


def test_a_process_waits_does_one_job_and_is_missed_by_nobody(
    settings: Settings, standby: Standby, tmp_path: Path
) -> None:
    waiting = _ready(standby)
    first = _process(tmp_path / "first", settings, standby)
    assert (first.was_ready, first.pid) == (True, waiting.process.pid)
    assert first.wait(60) == 1  # of an order that says nothing
    assert "KeyError" in "\n".join(first.lines())
    first.finish()
    cold = _process(tmp_path / "second", settings, standby)
    assert not cold.was_ready
    cold.stop()
    waiting = _ready(standby)
    waiting.process.kill()
    waiting.process.wait()
    third = _process(tmp_path / "third", settings, standby)
    assert not third.was_ready
    third.stop()


def test_a_process_that_still_loads_gets_no_job(
    settings: Settings, standby: Standby, tmp_path: Path
) -> None:
    standby.fill()
    [loading] = standby._waiting
    cold = _process(tmp_path / "cold", settings, standby)
    assert not cold.was_ready
    cold.stop()
    assert _ready(standby) is loading  # it is for the next job
    # a folder has any name that the system takes, and its bytes are what is told
    warm = _process(tmp_path / os.fsdecode(b"caf\xe9"), settings, standby)
    assert (warm.was_ready, warm.pid) == (True, loading.process.pid)
    assert warm.wait(60) == 1
    assert "KeyError" in "\n".join(warm.lines())
    warm.finish()


def test_processes_that_cannot_load_say_why_and_are_given_up(
    standby: Standby, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "python"
    broken.write_text("#!/bin/sh\necho no module named igl\nexit 1\n")
    broken.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(broken))
    started = set()
    with capture_logs() as logs:
        for number in range(6):
            standby.fill()
            for each in standby._waiting:
                started.add(each.process.pid)
                each.process.wait(60)
            if number % 2:  # a job notices as well
                assert standby.take(tmp_path) is None
    assert len(started) == MOST_FAILURES
    assert [each["event"] for each in logs] == ["standby.ended"] * 3 + ["standby.given_up"]
    assert (logs[0]["code"], logs[0]["said"]) == (1, "no module named igl")


def test_what_waits_ends_with_its_worker(settings: Settings) -> None:
    standby = Standby(settings, 1)
    standby.fill()
    [waiting] = standby._waiting
    assert waiting.process.stdin is not None
    waiting.process.stdin.close()  # as when the worker is gone
    assert waiting.process.wait(60) == 0
    standby.stop()


def test_nobody_waits_who_could_not_be_confined(settings: Settings) -> None:
    standby = Standby(settings.model_copy(update={"solver_confined": False}), 1)
    standby.fill()
    assert standby.take(Path()) is None


def test_a_process_with_threads_is_not_confined() -> None:
    held = threading.Event()
    thread = threading.Thread(target=held.wait)
    thread.start()
    try:
        with pytest.raises(OSError, match="threads that run already"):
            sandbox.confine((), (), ())
    finally:
        held.set()
        thread.join()


def test_code_that_starts_threads_takes_no_job(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solve, "AHEAD", ())
    monkeypatch.setattr(sandbox, "count_threads", lambda: 2)
    monkeypatch.setattr(solve, "die_with_parent", lambda *_: None)
    with pytest.raises(SystemExit, match="threads"):
        solve.stand_by(os.getppid(), 1)
