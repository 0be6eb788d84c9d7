"""``report.json``: how well each expression was fitted, in mm over the face."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from solver.rig.result import ExpressionFit, Rig
from solver.surface import Ints


def report(rig: Rig) -> dict[str, Any]:
    """Return the figures of a rig as plain JSON values; distances in mm, times in seconds.

    Means are over the part of ``model.face`` that the scan shows (``coverage``), ``train_mean_mm``
    and ``test_mean_mm`` are the means of the expressions' means (None without any). ``inverted`` is
    the sum over the expressions.
    """
    model = rig.model
    return {
        "expressions": {
            fit.name: _expression(fit, model.face, model.regions) for fit in rig.expressions
        },
        "train_mean_mm": _role_mean(rig, "train"),
        "test_mean_mm": _role_mean(rig, "test"),
        "inverted": sum(fit.inverted for fit in rig.expressions),
        "tets": len(model.tets),
        "vertices": len(model.rest),
        "muscles": model.muscle_count,
        "seconds": {phase: round(seconds, 3) for phase, seconds in rig.seconds.items()},
    }


def write_report(path: Path, rig: Rig) -> None:
    """Write :func:`report` as strict JSON (no NaN)."""
    path.write_text(json.dumps(report(rig), indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _expression(fit: ExpressionFit, face: Ints, regions: dict[str, Ints]) -> dict[str, Any]:
    error = fit.measured_error(face)
    return {
        "role": fit.role,
        "coverage": round(len(error) / len(face), 4),
        "mean_mm": _mm(error.mean()),
        "p95_mm": _mm(np.percentile(error, 95)),
        "max_mm": _mm(error.max()),
        "inverted": fit.inverted,
        "iterations": fit.iterations,
        "seconds": round(fit.seconds, 3),
        "jaw": [round(float(value), 6) for value in fit.jaw],
        "regions": {
            name: _mm(seen.mean())
            for name, ids in regions.items()
            if len(seen := fit.measured_error(np.intersect1d(ids, face)))
        },
    }


def _role_mean(rig: Rig, role: str) -> float | None:
    means = [
        fit.measured_error(rig.model.face).mean() for fit in rig.expressions if fit.role == role
    ]
    return _mm(np.mean(means)) if means else None


def _mm(value: float | np.floating) -> float:
    return round(float(value), 4)
