"""The scans of one session: a neutral, the expressions to train on and the unseen ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from solver.surface import Surface

OBJ_DECIMALS = 6


@dataclass(frozen=True)
class CaptureSet:
    """Registered scans of one subject, in mm, all with the faces of ``neutral``.

    ``train`` are the expressions that the muscle geometry is fitted to, ``test`` those that are
    solved for activations only; the keys are the expressions' names.
    """

    neutral: Surface
    train: dict[str, Surface]
    test: dict[str, Surface]

    def write(self, folder: Path) -> dict[str, Path]:
        """Write every scan as OBJ into ``folder`` and return name -> path (``neutral`` first)."""
        folder.mkdir(parents=True, exist_ok=True)
        scans = {"neutral": self.neutral, **self.train, **self.test}
        paths = {name: folder / f"{name}.obj" for name in scans}
        for name, scan in scans.items():
            write_obj(paths[name], scan)
        return paths


def write_obj(path: Path, surface: Surface) -> None:
    """Write triangles as Wavefront OBJ, in mm with six decimals."""
    with path.open("w", encoding="ascii") as stream:
        stream.write("# units: mm\n")
        np.savetxt(
            stream, surface.vertices, fmt=f"v %.{OBJ_DECIMALS}f %.{OBJ_DECIMALS}f %.{OBJ_DECIMALS}f"
        )
        np.savetxt(stream, surface.faces + 1, fmt="f %d %d %d")
