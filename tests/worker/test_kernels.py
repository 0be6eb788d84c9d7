"""The installation's compiled kernels."""

import os
import signal
import subprocess
import sys

import psutil
import pytest

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
