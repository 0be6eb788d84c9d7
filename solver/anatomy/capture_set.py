"""The scans of one session: a neutral, the expressions to train on and the unseen ones."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from pathlib import Path

from solver.scans.obj import write_obj
from solver.surface import Surface


@dataclass(frozen=True)
class CaptureSet:
    """Registered scans of one subject, in mm, all with the faces of ``neutral``.

    ``train`` are the expressions that the muscle geometry is fitted to, ``test`` those that are
    solved for activations only; the keys are the expressions' names.
    """

    neutral: Surface
    train: dict[str, Surface]
    test: dict[str, Surface]

    def first(self, train: int, test: int) -> CaptureSet:
        """Return the neutral with the first expressions only."""
        return CaptureSet(
            self.neutral,
            dict(islice(self.train.items(), train)),
            dict(islice(self.test.items(), test)),
        )

    def write(self, folder: Path) -> dict[str, Path]:
        """Write every scan as OBJ into ``folder`` and return name -> path (``neutral`` first)."""
        folder.mkdir(parents=True, exist_ok=True)
        scans = {"neutral": self.neutral, **self.train, **self.test}
        paths = {name: folder / f"{name}.obj" for name in scans}
        for name, scan in scans.items():
            write_obj(paths[name], scan)
        return paths
