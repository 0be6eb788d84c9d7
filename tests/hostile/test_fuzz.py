"""No reader of strangers' bytes crashes, hangs or takes more than its memory."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_hostile_inputs() -> None:
    command = [sys.executable, "-m", "fuzz", "--inputs", "2400", "--seed", "7"]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stdout + run.stderr
    total = re.search(r"(\d+) hostile inputs, 0 crashes", run.stdout)
    assert total
    assert int(total[1]) >= 2000, run.stdout
