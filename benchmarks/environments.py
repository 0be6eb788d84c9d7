"""A peer's own Python environment: made once in the cache folder, by ``venv`` and ``pip``."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from solver.cache import cache_directory

VERSIONS = ((3, 12), (3, 13))
INSTALL_LIMIT_S = 900.0


class UnavailableError(Exception):
    """The environment cannot be made; the message is the reason."""


def environment(name: str, requirements: Sequence[str], python: str | None = None) -> Path:
    """Return the interpreter of an environment with these requirements, making it if need be.

    ``python`` is the interpreter to make it with, by default one found on this machine. Raises
    :class:`UnavailableError`.
    """
    folder = cache_directory() / "peers" / name
    inside = folder / "bin" / "python"
    ready = folder / "installed.txt"
    wanted = "\n".join(requirements)
    if ready.exists() and ready.read_text(encoding="utf-8") == wanted:
        return inside
    base = python or find_python()
    shutil.rmtree(folder, ignore_errors=True)
    _run([base, "-m", "venv", str(folder)])
    _run([str(inside), "-m", "pip", "install", "--quiet", *requirements])
    ready.write_text(wanted, encoding="utf-8")
    return inside


def find_python() -> str:
    """Return an interpreter of one of :data:`VERSIONS`; raises :class:`UnavailableError`."""
    for candidate in _candidates():
        if version(candidate) in VERSIONS:
            return candidate
    names = " or ".join(f"{major}.{minor}" for major, minor in VERSIONS)
    raise UnavailableError(f"no Python {names} on this machine; --python takes one")


def _candidates() -> Iterator[str]:
    yield sys.executable
    for major, minor in VERSIONS:
        if found := shutil.which(f"python{major}.{minor}"):
            yield found
        if uv := shutil.which("uv"):
            search = [uv, "python", "find", "--no-python-downloads", f"{major}.{minor}"]
            yield subprocess.run(search, capture_output=True, text=True, check=False).stdout.strip()
        pyenv = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv")
        yield from map(str, sorted(pyenv.glob(f"versions/{major}.{minor}.*/bin/python")))


def version(python: str) -> tuple[int, ...] | None:
    """Return an interpreter's (major, minor); None if it does not run, as a pyenv shim may."""
    question = "import sys; print(*sys.version_info[:2])"
    try:
        answer = subprocess.run(
            [python, "-c", question], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return tuple(map(int, answer.stdout.split()))


def _run(command: Sequence[str]) -> None:
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=INSTALL_LIMIT_S)
    except subprocess.TimeoutExpired as error:
        reason = f"{' '.join(command[1:4])} took more than {INSTALL_LIMIT_S:.0f} s"
        raise UnavailableError(reason) from error
    except (OSError, subprocess.CalledProcessError) as error:
        said = (getattr(error, "stderr", "") or str(error)).strip().splitlines()
        raise UnavailableError(f"{' '.join(command[1:4])}: {said[-1]}") from error
