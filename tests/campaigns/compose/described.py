"""The compose file as data, validated by docker-compose itself, which needs no engine for that."""

from __future__ import annotations

import fnmatch
import re
import shlex
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from tests.servers import UnavailableError

ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Service:
    """What a container runs, with which variables, and how its health is asked for."""

    command: list[str]
    environment: dict[str, str]
    health: list[str]
    described: dict[str, Any]


def services() -> dict[str, Service]:
    """Return the services of ``docker-compose.yml``.

    Raises
    ------
    UnavailableError
        If docker-compose is not installed.
    ValueError
        If the file is not valid; the message is docker-compose's.
    """
    program = shutil.which("docker-compose")
    if program is None:
        raise UnavailableError("no docker-compose here: apt-get install docker-compose")
    done = subprocess.run(
        [program, "config"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise ValueError(done.stderr)
    return {name: _service(each) for name, each in yaml.safe_load(done.stdout)["services"].items()}


def _service(described: dict[str, Any]) -> Service:
    words = [*_words(described.get("entrypoint")), *_words(described.get("command"))]
    environment = {key: str(value) for key, value in described.get("environment", {}).items()}
    test = described.get("healthcheck", {}).get("test", [])
    health = ["sh", "-c", *test[1:]] if test[:1] == ["CMD-SHELL"] else test[1:]
    return Service(words, environment, [_plain(word) for word in health], described)


def _words(given: str | list[str] | None) -> list[str]:
    words = shlex.split(given) if isinstance(given, str) else list(given or ())
    return [_plain(word) for word in words]


def _plain(word: str) -> str:
    """Return a word as a container gets it: the file doubles the dollars of no variable of its."""
    return word.replace("$$", "$")


def check_build_context() -> list[str]:
    """Return what the Dockerfile copies but the build's context does not have."""
    faults = []
    for line in (ROOT / "Dockerfile").read_text().splitlines():
        if match := re.fullmatch(r"COPY (?!--from)(.+) \S+", line):
            faults += [
                f"Dockerfile: {source} is not in the build context"
                for source in match[1].split()
                if not (ROOT / source).exists() or not _is_sent(source)
            ]
    return faults


def healthcheck() -> list[str]:
    """Return the image's health check."""
    text = (ROOT / "Dockerfile").read_text()
    found = re.search(r"^HEALTHCHECK.*?\bCMD\s*\\?\s*(\[.*?\])$", text, re.MULTILINE | re.DOTALL)
    assert found is not None
    words: list[str] = yaml.safe_load(found[1])
    return words


def _is_sent(source: str) -> bool:
    """Tell whether ``.dockerignore`` lets a file or folder pass: its last fitting line decides."""
    sent = True
    for line in (ROOT / ".dockerignore").read_text().split():
        if fnmatch.fnmatch(source, line.lstrip("!")):
            sent = line.startswith("!")
    return sent
