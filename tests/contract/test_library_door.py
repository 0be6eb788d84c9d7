"""``from solver import ...``: the names of the library, imported when they are asked for."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import solver

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", solver.__all__)
def test_every_name_is_there(name: str) -> None:
    assert callable(getattr(solver, name))
    assert name in dir(solver)


def test_another_name_is_an_error() -> None:
    with pytest.raises(AttributeError, match="Visage"):
        _ = solver.Visage  # type: ignore[attr-defined]


def test_the_door_opens_without_numerics() -> None:
    code = "import sys, solver; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    loaded = done.stdout.split()
    assert not {"numpy", "scipy", "numba", "pydantic"} & set(loaded)
    assert [name for name in loaded if name.startswith("solver.")] == []
