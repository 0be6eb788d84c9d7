"""The suites by name, wherever their tests lie, and how a part of one is run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tests.campaigns.faults.catalogue import Selection

Outcome = Literal["passed", "failed", "skipped", "empty"]

# A suite's tests lie in the first of these folders that has any.
FOLDERS = {
    "unit solver": ("tests/unit/solver", "tests/solver"),
    "unit service": ("tests/unit/service", "tests/service"),
    "unit worker": ("tests/unit/worker", "tests/worker"),
    "unit myoface": ("tests/unit/myoface", "tests/myoface"),
    "contract": ("tests/contract",),
    "integration": ("tests/integration",),
    "hostile": ("tests/hostile", "tests/integration/hostile"),
    "page static": ("tests/browser", "tests/page"),
    "page": ("tests/browser", "tests/page"),
    "chaos": ("tests/chaos", "tests/kills"),
}
# Without servers that have to be installed, and as far as it goes without slow tests.
MARKS = dict.fromkeys(FOLDERS, "not servers and not slow") | {
    "page": "not servers",
    "chaos": "not servers",
}
# So many seconds a run may take: one that does not end has noticed the fault, too.
LONGEST = 300.0
NOTHING_SELECTED = 5


@dataclass(frozen=True)
class Run:
    """What became of a run: the first ``test`` that failed, and how long it took."""

    outcome: Outcome
    test: str
    seconds: float


def run(tree: Path, selection: Selection, kernels: Path) -> Run:
    """Run a part of a suite in ``tree`` until a test fails; compiled code is in ``kernels``."""
    began = time.monotonic()
    done = _part(tree, selection, kernels, selection.keywords)
    if done is not None and done[0] in (0, NOTHING_SELECTED) and selection.keywords:
        # the test that notices it may have another name by now
        done = _part(tree, selection, kernels, "")
    seconds = round(time.monotonic() - began, 1)
    if done is None:
        return Run("failed", f"no end within {LONGEST:.0f} s", seconds)
    code, output = done
    if code == NOTHING_SELECTED:
        return Run("empty", "", seconds)
    if code == 0:
        return Run("passed" if re.search(r"\d+ passed", output) else "skipped", "", seconds)
    found = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - |$)", output, re.MULTILINE)
    return Run("failed", found[1] if found else output.strip()[-200:], seconds)


def passes(tree: Path, test: str, kernels: Path) -> bool:
    """Tell whether one ``test``, or the import of one module, passes in ``tree``."""
    if not test.startswith("tests/"):
        return True
    done = _pytest(tree, [test] if "::" in test else ["--collect-only", test], kernels)
    return done is not None and done[0] == 0


def _part(tree: Path, selection: Selection, kernels: Path, keywords: str) -> tuple[int, str] | None:
    words = ["-m", MARKS[selection.suite], *(["-k", keywords] if keywords else [])]
    return _pytest(tree, [*words, *_paths(tree, selection)], kernels)


def _pytest(tree: Path, words: list[str], kernels: Path) -> tuple[int, str] | None:
    """Return the exit code and what was printed, None if there was no end."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-p", "no:cacheprovider"]
    environment = os.environ | {
        "PYTHONPATH": str(tree),
        "PYTHONDONTWRITEBYTECODE": "1",
        "NUMBA_CACHE_DIR": str(kernels),
    }
    process = subprocess.Popen(
        [*command, *words],
        cwd=tree,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    try:
        output, _ = process.communicate(timeout=LONGEST)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, 9)
        process.communicate()
        return None
    return process.returncode, output


def _paths(tree: Path, selection: Selection) -> list[str]:
    """Return the folders and modules of a selection that there are, else its whole suite."""
    candidates = FOLDERS[selection.suite]
    folders = [folder for folder in candidates if any((tree / folder).rglob("test_*.py"))]
    if not folders:
        raise FileNotFoundError(f"the suite {selection.suite!r} is nowhere: mend suites.py")
    folder = folders[0]
    found: list[Path] = []
    for place in selection.places:
        near = [tree / folder / place, tree / folder / f"test_{place}.py"]
        there = [path for path in near if path.exists()]
        found += there or sorted((tree / "tests").rglob(f"test_{place}.py"))
    return [str(path.relative_to(tree)) for path in dict.fromkeys(found)] or [folder]
