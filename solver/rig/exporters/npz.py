"""``rig.npz``: the rig in one file, which all jobs read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from solver.rig.rig import FILE as FILE
from solver.rig.rig import Rig

MEDIA_TYPE = "application/x-npz"
WITH_EVERY_RIG = True


@dataclass(frozen=True)
class Options:
    """There is nothing to choose."""


def write(rig: Rig, path: Path, _options: Options = Options()) -> None:
    """Write model, S, expressions and figures."""
    rig.save(path)
