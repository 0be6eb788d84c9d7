"""The Khronos glTF validator (npm package ``gltf-validator``), where node and npm are installed."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

VALIDATOR_FILES = ("package.json", "package-lock.json", "validate.mjs")
VALIDATOR_TIMEOUT_S = 180


@dataclass(frozen=True)
class Validation:
    """The Khronos validator's word; ``errors`` is None where it could not run, see ``note``."""

    errors: int | None
    warnings: int | None
    note: str


def khronos_validation(path: Path, cache: Path) -> Validation:
    """Validate a GLB; the package is installed into ``cache`` the first time."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        return Validation(None, None, "not run: it needs node and npm (apt-get install nodejs npm)")
    try:
        _install(npm, cache)
        command = [node, "validate.mjs", str(path.resolve())]
        done = subprocess.run(
            command, cwd=cache, capture_output=True, check=True, timeout=VALIDATOR_TIMEOUT_S
        )
    except (subprocess.SubprocessError, OSError) as error:
        return Validation(None, None, f"not run: {error}")
    issues = json.loads(done.stdout)
    first = issues["messages"][0]["message"] if issues["messages"] else ""
    return Validation(issues["numErrors"], issues["numWarnings"], first)


def _install(npm: str, cache: Path) -> None:
    if (cache / "node_modules" / "gltf-validator" / "package.json").exists():
        return
    cache.mkdir(parents=True, exist_ok=True)
    for name in VALIDATOR_FILES:
        text = resources.files("myoface.demo").joinpath("khronos", name).read_text()
        (cache / name).write_text(text)
    command = [npm, "ci", "--silent", "--no-audit", "--no-fund"]
    subprocess.run(command, cwd=cache, capture_output=True, check=True, timeout=VALIDATOR_TIMEOUT_S)
