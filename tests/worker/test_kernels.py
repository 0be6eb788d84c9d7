"""The installation's compiled kernels."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.command_line import invoke
from tests.service_client import eventually
from worker import kernels


@pytest.mark.skipif(sys.platform != "linux", reason="the system tells of a parent's end on Linux")
@pytest.mark.parametrize("begun_by", ["", "signal.signal(signal.SIGINT, signal.SIG_IGN)"])
def test_a_compilation_ends_with_the_worker_that_began_it(tmp_path, begun_by):
    """Also where the worker's shell has it ignore interrupts, as for what is in the background."""
    own = os.environ | {kernels.KERNELS_VARIABLE: str(tmp_path)}
    compile_all = (
        f"import signal; {begun_by}\nfrom worker.kernels import compile_all; compile_all()"
    )
    with subprocess.Popen([sys.executable, "-c", compile_all], env=own) as worker:
        begun = psutil.Process(worker.pid)
        eventually(lambda: any(each.num_threads() > 1 for each in begun.children()), 60)
        found = begun.children(recursive=True)
        worker.send_signal(signal.SIGKILL)
    gone, alive = psutil.wait_procs(found, timeout=30)
    assert gone
    assert not alive
    assert not list(tmp_path.glob("compiled"))


# Jobs in which an interruption is lost, as in a callback of the compiler.
STUBBORN = """
import pathlib, time
from worker import kernels
def jobs(folder):
    print(folder, flush=True)
    while True:
        try:
            time.sleep(60)
        except BaseException:
            pass
kernels._run_jobs = jobs
kernels.main()
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_compilation_ends_at_once_and_quietly(number, tmp_path):
    own = os.environ | {kernels.KERNELS_VARIABLE: str(tmp_path)}
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", STUBBORN]
    with subprocess.Popen(command, env=own, stdout=pipe, stderr=pipe, text=True) as child:
        folder = Path(child.stdout.readline().strip())
        assert folder.is_dir()
        child.send_signal(number)
        try:
            _, told = child.communicate(timeout=20)
        finally:
            child.kill()
    assert (child.returncode, told) == (128 + number, "")
    assert not folder.exists()


def test_a_compilation_ends_with_the_command_that_is_interrupted(tmp_path, monkeypatch):
    monkeypatch.setenv(kernels.KERNELS_VARIABLE, str(tmp_path))
    before = set(psutil.Process().children(recursive=True))  # servers that other tests share
    begun = []

    def interrupt(step):
        begun.append((step, *set(psutil.Process().children(recursive=True)) - before))
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        kernels.compile_all(interrupt)
    ((step, *children),) = begun
    assert step == "kernels of register_scan (1 of 5)"
    assert children
    assert not any(child.is_running() for child in children)
    assert not kernels.are_compiled()


class Listening:
    """A service that listens at once."""

    url = "http://127.0.0.1:1"
    key = "secret"

    def __init__(self, _settings):
        self.wait = None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


def test_the_service_listens_while_kernels_compile(tmp_path, monkeypatch):
    def compile_all(tell, **_):
        tell("kernels of register_scan (1 of 5)")
        raise KeyboardInterrupt

    monkeypatch.setenv(kernels.KERNELS_VARIABLE, str(tmp_path / "none"))  # stale ones are removed
    monkeypatch.setattr("myoface.stack.Stack", Listening)
    monkeypatch.setattr("worker.kernels.compile_all", compile_all)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr("myoface.cli.service.configure_logs", lambda _json: None)
    told = invoke(["up", "--data", str(tmp_path)])
    listens = told.stdout.index("listens on")
    compiles = told.stdout.index("kernels of register_scan")
    assert listens < compiles
    assert (told.exit_code, told.stderr) == (130, "")


@pytest.mark.long
@pytest.mark.parametrize("command", ["up", "demo"])
def test_no_job_is_given_kernels_of_older_code(command, tmp_path, monkeypatch):
    installed = tmp_path / "installed" / "mechanics_1"
    installed.mkdir(parents=True)
    (installed / "laws.energy-1.py311.nbi").touch()
    (installed.parent / "compiled").write_text("of another release")
    monkeypatch.setenv(kernels.KERNELS_VARIABLE, str(installed.parent))
    given = []

    class Stack(Listening):
        def __enter__(self):
            kernels.link_kernels(tmp_path / "attempt")
            given.extend((tmp_path / "attempt").glob("*/*"))
            return self

    def compile_all(_tell, **_):
        raise KeyboardInterrupt

    monkeypatch.setattr("myoface.stack.Stack", Stack)
    monkeypatch.setattr("worker.kernels.compile_all", compile_all)
    monkeypatch.setattr("signal.signal", lambda *_: None)
    monkeypatch.setattr("myoface.cli.service.configure_logs", lambda _json: None)
    told = invoke([command, "--data" if command == "up" else "--output", str(tmp_path / "data")])
    assert told.exit_code == 130, told
    assert given == []
