"""The solver's compiled kernels: made from trusted input, read by every attempt, written by none.

Numba keeps what it compiled in pickles, and reading a pickle runs what is in it. So no solver
process, which reads strangers' files, may write where the next one reads: the installation's are
compiled here, and an attempt has a folder of its own with links to them. Numba replaces files and
never writes into one, so what it adds or compiles anew stays in that folder.

``python -m worker.kernels`` compiles them, about a minute and a half on two processors, unless they
are there.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import importlib.metadata
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from service.process import die_with_parent

SOLVER = Path(__file__).resolve().parents[1] / "solver"
# The installation's folder where it is not beside the code, as in a read-only image
KERNELS_VARIABLE = "NUMBA_CACHE_DIR"
ENDS = (signal.SIGINT, signal.SIGTERM)  # what ends a compilation
GRACE = 2.0  # s until a compilation that was told to end is killed


def link_kernels(folder: Path) -> None:
    """Link the installation's kernels into ``folder``, laid out as numba looks for them there."""
    place = installed_place()
    for kernel in _kernels():
        home = folder / (kernel.parent.name if place else _subfolder(kernel.parents[1]))
        home.mkdir(parents=True, exist_ok=True)
        (home / kernel.name).symlink_to(kernel)


def are_compiled() -> bool:
    """Tell whether the installation's kernels are of this code."""
    try:
        return _stamp().read_text() == _hash() and any(_kernels())
    except OSError:
        return False


def remove_stale() -> None:
    """Remove kernels that are not of this code, before a job is given them.

    A process that compiles at the moment has removed them; where nothing can be written they stay.
    """
    with suppress(OSError), _lock_file().open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not are_compiled():
            _remove_all()


def compile_all(tell: Callable[[str], object] | None = None, *, niceness: int = 10) -> None:
    """Compile the kernels that jobs use, unless they are of this code already.

    Processes that want it at the same time do it once. ``tell`` is called with each step. Checks
    of scans come first, unless ``niceness`` is 0.

    Raises
    ------
    subprocess.CalledProcessError
        If one of the jobs that use them failed.
    """
    with _lock_file().open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not are_compiled():
            _compile_apart(tell, niceness)


def _compile_apart(tell: Callable[[str], object] | None, niceness: int) -> None:
    """Compile in a process of its own, which ends when this one is interrupted."""
    command = ["nice", "-n", str(niceness), sys.executable]
    command += ["-m", "worker.kernels", "--parent", str(os.getpid())]
    with subprocess.Popen(command, cwd=SOLVER.parent, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        try:
            for line in child.stdout:
                if tell is not None:
                    tell(line.rstrip())
        except BaseException:
            child.terminate()
            try:
                child.wait(GRACE)
            except subprocess.TimeoutExpired:
                child.kill()
            raise
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, command)


def _run_jobs(folder: Path) -> None:
    """Do a job of each sort on the built-in person, which compiles what they call.

    The built-in template stays in the installation's cache.
    """
    from solver.jobs import run_job
    from solver.templates.builtin.build import builtin_capture_set

    scans = builtin_capture_set().first(1, 1).write(folder / "scans")
    neutral, *train, test = scans
    rig = folder / "rig" / "rig.npz"
    scene = {
        "duration": 0.1,
        "mode": "dynamic",
        "keys": [{"time": 0.1, "expressions": {train[0]: 1.0}}],
    }
    jobs: list[tuple[str, str, dict[str, Any]]] = [
        ("register_scan", "registered", {"scan": scans[neutral], "role": "neutral"}),
        ("build_model", "model", {"neutral": scans[neutral]}),
        (
            "fit_geometry",
            "rig",
            {
                "model": folder / "model" / "model.npz",
                "captures": {name: scans[name] for name in train},
                "options": {"rounds": 1},
            },
        ),
        (
            "fit_activations",
            "new",
            {"captures": {test: scans[test]}, "rig": rig, "options": {"max_iterations": 2}},
        ),
        ("simulate", "film", {"options": {"scene": scene}, "rig": rig}),
    ]
    for number, (kind, place, inputs) in enumerate(jobs, 1):
        print(f"kernels of {kind} ({number} of {len(jobs)})", flush=True)  # noqa: T201
        run_job(kind, folder / place, **inputs)


def installed_place() -> Path | None:
    """Return the installation's folder; None: each kernel is beside its code."""
    place = os.environ.get(KERNELS_VARIABLE)
    return Path(place).absolute() if place else None


def _kernels() -> Iterator[Path]:
    place = installed_place()
    return place.glob("*/*.nb[ic]") if place else SOLVER.rglob("__pycache__/*.nb[ic]")


def _remove_all() -> None:
    for kernel in _kernels():
        kernel.unlink(missing_ok=True)


def _subfolder(package: Path) -> str:
    """Return numba's name, below its folder of caches, for the kernels of a package."""
    return f"{package.name}_{hashlib.sha1(str(package).encode()).hexdigest()}"


def _hash() -> str:
    """Return a hash of the sources with kernels, and of numba's release."""
    hashed = hashlib.sha256(importlib.metadata.version("numba").encode())
    for source in sorted(SOLVER.rglob("*.py")):
        text = source.read_bytes()
        if b"njit" in text:
            hashed.update(text)
    return hashed.hexdigest()


def _stamp() -> Path:
    return (installed_place() or SOLVER / "__pycache__") / "compiled"


def _lock_file() -> Path:
    file = _stamp().with_suffix(".lock")
    file.parent.mkdir(parents=True, exist_ok=True)
    return file


def main() -> None:
    """Compile the kernels, unless they are of this code, and note of which code they are."""
    parser = argparse.ArgumentParser(prog="python -m worker.kernels", description=main.__doc__)
    parser.add_argument("--parent", type=int, help="process whose end is the end of this one, too")
    parent = parser.parse_args().parent
    if are_compiled():
        return
    with tempfile.TemporaryDirectory(prefix="myoface-kernels-") as name:
        _end_when_told(Path(name))
        if parent:
            die_with_parent(parent, signal.SIGTERM)
        _remove_all()  # numba does not see that a function elsewhere has changed
        _run_jobs(Path(name))
    _stamp().parent.mkdir(parents=True, exist_ok=True)
    _stamp().write_text(_hash())


def _end_when_told(folder: Path) -> None:
    """Have this process end at once and quietly at SIGINT or SIGTERM, and leave no ``folder``.

    A thread waits for them: an exception that is raised in a callback of the compiler is lost.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)

    def wait() -> None:
        number = signal.sigwait(ENDS)
        shutil.rmtree(folder, ignore_errors=True)
        os._exit(128 + number)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    main()
