"""Outcome of a demonstration: figures, bars, and the checks of its files."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

VALIDATOR_FILES = ("package.json", "package-lock.json", "validate.mjs")
VALIDATOR_TIMEOUT_S = 180


@dataclass(frozen=True)
class Validation:
    """The Khronos validator's word; ``errors`` is None where it could not run, see ``note``."""

    errors: int | None
    warnings: int | None
    note: str


@dataclass(frozen=True)
class Bars:
    """Mean distances over the face skin, in mm, that a fit must not exceed."""

    train_mm: float
    test_mm: float


def millimetres(mean: float | None) -> str:
    """Return a mean distance in words; None: there were no scans to take it over."""
    return "no scans" if mean is None else f"{mean:.3f} mm"


@dataclass(frozen=True)
class DemoOutcome:
    """A finished demonstration; ``report`` is the rig's report.json, ``seconds`` per phase."""

    report: dict[str, Any]
    seconds: dict[str, float]
    glb_faults: list[str]
    khronos: Validation
    bars: Bars | None

    def failures(self) -> list[str]:
        """Return in words which bars are missed and which checks failed."""
        failures = [f"rig.glb: {fault}" for fault in self.glb_faults]
        if self.khronos.errors:
            failures.append(
                f"rig.glb: {self.khronos.errors} errors by Khronos: {self.khronos.note}"
            )
        if self.bars is None:
            return failures
        means = (
            ("training", self.report["train_mean_mm"], self.bars.train_mm),
            ("unseen", self.report["test_mean_mm"], self.bars.test_mm),
        )
        for title, mean, bar in means:
            if mean is not None and not mean <= bar:
                failures.append(f"{title} mean {mean:.3f} mm is over the bar of {bar} mm")
        return failures

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as JSON values (``seconds`` in all, ``phase_seconds`` each)."""
        copied = ("train_mean_mm", "test_mean_mm", "inverted", "tets", "vertices", "muscles")
        return {
            **{key: self.report[key] for key in copied},
            "seconds": round(sum(self.seconds.values()), 1),
            "phase_seconds": {phase: round(spent, 2) for phase, spent in self.seconds.items()},
            "expressions": self.report["expressions"],
            "glb_faults": self.glb_faults,
            "khronos_errors": self.khronos.errors,
            "khronos_warnings": self.khronos.warnings,
            "failures": self.failures(),
        }


def khronos_validation(path: Path, cache: Path) -> Validation:
    """Validate a GLB; the package is installed into ``cache`` the first time."""
    node = shutil.which("node")
    npm = shutil.which("npm")
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
