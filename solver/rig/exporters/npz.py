"""``rig.npz``: the rig in one file, which all jobs read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from solver.rig.exporters import NO_OPTIONS
from solver.rig.exporters import NoOptions as Options
from solver.rig.expression import FILE as FILE
from solver.rig.frames.read_back import compare_expressions
from solver.rig.rig import Rig

MEDIA_TYPE = "application/x-npz"
WITH_EVERY_RIG = True


def write(rig: Rig, path: Path, _options: Options = NO_OPTIONS) -> None:
    """Write model, S, expressions and figures."""
    rig.save(path)


def read_back(rig: Rig, path: Path, _options: Options = NO_OPTIONS) -> dict[str, Any]:
    """Return how far the file's skins are off the rig's."""
    return compare_expressions(path, Rig.load(path).skins(), rig.skins())
