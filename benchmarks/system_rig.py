"""One rig with every system, for :mod:`benchmarks.systems`: its files, and what they show."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.documents import Figures, Table
from myoface.demo.outcome import khronos_validation
from solver.cache import cache_directory
from solver.rig import ExpressionFit, Rig
from solver.rig.exporters import export_measured
from solver.rig.report.systems import SYSTEMS, SystemMeasures

MB = 1e6
# figure -> exporter and its file
FILES = {"rig": ("npz", "rig.npz"), "glb": ("systems", "systems.glb"), "usd": ("usd", "rig.usdc")}
NEAR_MM = 0.05  # that the skin comes back to, from rest

log = logging.getLogger(__name__)


def rig_figures(rig: Rig) -> Figures:
    """Return what the files of a rig with several systems weigh and show."""
    with TemporaryDirectory() as folder:
        found: Figures = {"expressions": len(rig.expressions)}
        for name, (exporter, file) in FILES.items():
            if exporter == "usd" and not find_spec("pxr"):
                continue
            path = Path(folder) / file
            made = export_measured(rig, exporter, path)
            found[f"{name}_mb"] = path.stat().st_size / MB
            found[f"{name}_off_mm"] = made.figures["max_mm"]
        glb = khronos_validation(Path(folder) / "systems.glb", cache_directory() / "gltf-validator")
        found |= {"khronos_errors": glb.errors, "khronos_warnings": glb.warnings}
        read = Rig.load(Path(folder) / "rig.npz")
    measures = SystemMeasures.of(read)
    found["systems"] = {
        system: _summary([measures.figures(fit) for fit in fits], fits)
        for system, fits in read.fits_by_system.items()
    }
    log.info("rig: %s", found)
    return found


def rig_tables(name: str, figures: Figures) -> list[Table]:
    """Return the tables of the rig of the subject called ``name``."""
    each = {"mean_mm": "mean, mm", "p95_mm": "95 %, mm", "inverted": "inverted tets, worst"}
    each |= {"seconds": "s an expression", "round_trip_mm": "from rest, worst, mm"}
    each |= {"back": f"within {NEAR_MM:g} mm"}
    rows = [
        [f"{system}, {SYSTEMS[system]}", *(found[key] for key in each)]
        for system, found in figures["systems"].items()
    ]
    caption = f"{name}, {figures['expressions']} scans in one rig:"
    weights = {"rig_mb": "rig.npz, MB", "glb_mb": "systems.glb, MB", "usd_mb": "rig.usdc, MB"}
    weights |= {"glb_off_mm": "systems.glb off, mm", "usd_off_mm": "rig.usdc off, mm"}
    weights |= {"khronos_errors": "errors by Khronos"}
    files = [[figures.get(key) for key in weights]]
    return [
        Table(["system", *each.values()], rows, caption),
        Table([*weights.values()], files, "Its files:"),
    ]


def _summary(figures: Sequence[Mapping[str, float]], fits: Sequence[ExpressionFit]) -> Figures:
    """Return the means of a system's fits, and the worst of their round trips from rest."""
    trips = [np.nan if fit.round_trip is None else fit.round_trip.skin_mean_mm for fit in fits]
    reached = [trip for trip in trips if np.isfinite(trip)]
    return {
        "mean_mm": float(np.mean([each["mean_mm"] for each in figures])),
        "p95_mm": float(np.mean([each["p95_mm"] for each in figures])),
        "inverted": max(fit.inverted for fit in fits),
        "seconds": float(np.mean([fit.seconds for fit in fits])),
        "round_trip_mm": max(reached, default=None),
        "back": sum(trip <= NEAR_MM for trip in reached),
        "targets": {fit.name: trip for fit, trip in zip(fits, trips, strict=True)},
    }
