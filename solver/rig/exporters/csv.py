"""``activations.csv``: every muscle in every expression, for spreadsheets; who pulls is first."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from solver.rig.expression import ENTRIES
from solver.rig.frames.read_back import compare_activations
from solver.rig.rig import Rig

FILE = "activations.csv"
MEDIA_TYPE = "text/csv"
WITH_EVERY_RIG = True
JAW = ("jaw.1", "jaw.2", "jaw.3", "jaw.4", "jaw.5")


@dataclass(frozen=True)
class Options:
    """Format of the numbers."""

    decimals: Annotated[int, Field(ge=0, le=17)] = 6


def write(rig: Rig, path: Path, options: Options = Options()) -> None:
    """Write a row for every expression and muscle, as docs/reference/rig-format.md describes."""
    figures = rig.known_figures()
    decimals = options.decimals
    with path.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        heads = ["expression", "role", "muscle", "contraction", "fibres", *ENTRIES, *JAW]
        rows.writerow(heads)
        for fit in rig.expressions:
            muscles = figures["expressions"][fit.name]["muscles"]
            jaw = [f"{value:.{decimals}f}" for value in fit.jaw]
            for muscle, activation in zip(rig.model.muscle_names, fit.activations, strict=True):
                values = [f"{value:.{decimals}f}" for value in activation]
                fibres = muscles[muscle]["fibres"]  # None is an empty cell
                contraction = None if fibres is None else round(1.0 - fibres, 4)
                own = [fit.name, fit.role, muscle, contraction, fibres]
                rows.writerow([*own, *values, *jaw])


def read_back(rig: Rig, path: Path, options: Options = Options()) -> dict[str, Any]:
    """Return how far an activation in the file is off the rig's, at most: by its decimals."""
    wanted = np.array([fit.activations for fit in rig.expressions]).reshape(-1, len(ENTRIES))
    with path.open(newline="", encoding="utf-8") as stream:
        rows = [[float(row[entry]) for entry in ENTRIES] for row in csv.DictReader(stream)]
    shown = np.array(rows).reshape(-1, len(ENTRIES))
    return compare_activations(path, shown, wanted, 10.0**-options.decimals)
