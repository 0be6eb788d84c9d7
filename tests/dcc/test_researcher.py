"""Every snippet of README, the researcher's guide and the notebook runs, on a small rig."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from solver.jobs import run_job
from solver.templates.builtin.build import builtin_capture_set

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder like that of `make demo`: a coarse rig of the built-in face."""
    folder = tmp_path_factory.mktemp("rig")
    scans = builtin_capture_set().first(2, 0).write(folder / "scans")
    neutral, model = scans.pop("neutral"), folder / "model.npz"
    run_job("build_model", folder, options={"edge_mm": 16.0}, neutral=neutral)
    run_job("fit_geometry", folder, options={"rounds": 2}, captures=scans, model=model)
    return folder


def readme() -> str:
    return _python(ROOT / "README.md")


def guide() -> str:
    return _python(ROOT / "docs" / "science" / "researcher.md")


def _python(document: Path) -> str:
    text = document.read_text(encoding="utf-8")
    return "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))


def notebook() -> str:
    cells = json.loads(
        (ROOT / "docs" / "examples" / "researcher.ipynb").read_text(encoding="utf-8")
    )["cells"]
    return "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")


@pytest.mark.parametrize("script", [readme, guide, notebook], ids=["readme", "guide", "notebook"])
def test_the_snippets_run(script: Callable[[], str], rig: Path, tmp_path: Path) -> None:
    shutil.copytree(rig, tmp_path / "demo-output")
    code = script()
    assert code.count("\n") > 7
    child = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin", "HOME": str(Path.home())},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert child.returncode == 0, child.stdout + child.stderr
