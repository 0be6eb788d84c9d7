"""``activations.csv``: what every muscle does in every expression, for spreadsheets and scripts."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

from solver.rig.result import Rig

ENTRIES = ("xx", "xy", "xz", "yy", "yz", "zz")
JAW = ("jaw.1", "jaw.2", "jaw.3", "jaw.4", "jaw.5")


def write_activations_csv(path: Path, rig: Rig, figures: dict[str, Any]) -> None:
    """Write a row for every expression and muscle, as docs/rig-format.md describes.

    ``figures`` are :func:`solver.rig.report.report` of the rig.
    """
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(["expression", "role", "muscle", "fibres", *ENTRIES, *JAW])
        for fit in rig.expressions:
            muscles = figures["expressions"][fit.name]["muscles"]
            jaw = [f"{value:.6f}" for value in fit.jaw]
            for muscle, activation in zip(rig.model.muscle_names, fit.activations, strict=True):
                values = [f"{value:.6f}" for value in activation]
                fibres = muscles[muscle]["fibres"]  # None is an empty cell
                rows.writerow([fit.name, fit.role, muscle, fibres, *values, *jaw])
