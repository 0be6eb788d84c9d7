"""The solver's compiled kernels: made from trusted input, lent to each attempt as a copy.

Numba keeps what it compiled in pickles, and reading a pickle runs what is in it. So no solver
process, which reads strangers' files, may write where the next one reads: the installation's are
compiled here, and an attempt gets a copy in its own folder, where it may add what is missing.

``python -m worker.kernels`` compiles them, about a minute and a half on two processors.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

SOLVER = Path(__file__).resolve().parents[1] / "solver"
# The installation's folder where it is not beside the code, as in a read-only image
VARIABLE = "NUMBA_CACHE_DIR"


def lend(folder: Path) -> None:
    """Copy the installation's kernels into ``folder``, laid out as numba looks for them there."""
    place = os.environ.get(VARIABLE)
    if place:
        if Path(place).is_dir():
            shutil.copytree(place, folder, dirs_exist_ok=True)
        return
    for kernel in _beside_the_code():
        home = folder / _subfolder(kernel.parents[1])
        home.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(kernel, home / kernel.name)


def are_compiled() -> bool:
    """Tell whether the installation's kernels are of this code."""
    try:
        return _stamp().read_text() == _hash()
    except OSError:
        return False


def compile_all() -> None:
    """Compile the kernels that jobs use, unless they are of this code already.

    Processes that want it at the same time do it once.

    Raises
    ------
    subprocess.CalledProcessError
        If one of the jobs that use them failed.
    """
    stamp = _stamp()
    stamp.parent.mkdir(parents=True, exist_ok=True)
    with stamp.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not are_compiled():
            command = ["nice", sys.executable, "-m", "worker.kernels"]
            subprocess.run(command, cwd=SOLVER.parent, check=True, stdout=subprocess.DEVNULL)


def _run_jobs(folder: Path) -> None:
    """Do a job of each sort on the built-in person, which compiles what they call.

    The built-in template's tetrahedra, of the usual size, stay in the installation's cache.
    """
    from solver.jobs import run_job
    from solver.templates.builtin.build import builtin_capture_set

    scans = builtin_capture_set().first(2, 1).write(folder / "scans")
    neutral, *train, test = scans
    run_job("register_scan", folder / "registered", scan=scans[neutral], role="neutral")
    run_job("build_model", folder / "model", neutral=scans[neutral])
    run_job(
        "fit_geometry",
        folder / "rig",
        model=folder / "model" / "model.npz",
        captures={name: scans[name] for name in train},
        options={"rounds": 1},
    )
    rig = folder / "rig" / "rig.npz"
    run_job("fit_activations", folder / "new", captures={test: scans[test]}, rig=rig)
    scene = {
        "duration": 0.1,
        "mode": "dynamic",
        "keys": [{"time": 0.1, "expressions": {train[0]: 1.0}}],
    }
    run_job("simulate", folder / "film", options={"scene": scene}, rig=rig)


def _beside_the_code() -> Iterator[Path]:
    return SOLVER.rglob("__pycache__/*.nb[ic]")


def _subfolder(package: Path) -> str:
    """Return numba's name, below its folder of caches, for the kernels of a package."""
    return f"{package.name}_{hashlib.sha1(str(package).encode()).hexdigest()}"


def _hash() -> str:
    """Return a hash of the sources with kernels."""
    hashed = hashlib.sha256()
    for source in sorted(SOLVER.rglob("*.py")):
        text = source.read_bytes()
        if b"njit" in text:
            hashed.update(text)
    return hashed.hexdigest()


def _stamp() -> Path:
    place = os.environ.get(VARIABLE)
    return (Path(place) if place else SOLVER / "__pycache__") / "compiled"


def main() -> None:
    """Compile the kernels and note of which code they are."""
    with tempfile.TemporaryDirectory(prefix="myoface-kernels-") as name:
        _run_jobs(Path(name))
    _stamp().parent.mkdir(parents=True, exist_ok=True)
    _stamp().write_text(_hash())


if __name__ == "__main__":
    main()
