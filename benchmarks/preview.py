"""Errors of a rig's sliders against the simulation they stand for, and the time to make them.

A face is fitted to its training expressions, then its preview is made as the job does. ``mean_mm``,
``p95_mm`` and ``max_mm`` are over random plausible poses that it was not made from, on the face's
vertices; ``sorts`` has every sort of unseen poses, ``presets`` the mean at the fitted
expressions.
"""

from __future__ import annotations

import argparse
import logging
import time

import numpy as np

from benchmarks import report, subject_fits, subjects
from benchmarks.documents import Figures, Section, Table
from benchmarks.subjects import COARSE_EDGE_MM, EDGE_MM
from solver.fitting.face import Face
from solver.jobs.build_preview import TOLERANCE
from solver.mechanics.linear import fastest
from solver.rig.preview import make_preview

SEED = 0


def main() -> None:
    """Run from the command line."""
    parser = report.parser(__doc__ or "")
    subjects.add_options(parser)
    subjects.add_controls(parser)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    report.finish(run(options), options, section)


def run(options: argparse.Namespace) -> Figures:
    """Fit, make the preview and return the figures."""
    quick = options.quick
    model, captures = subjects.load(options, COARSE_EDGE_MM if quick else EDGE_MM)
    schedule = subjects.schedule(options, model, quick=options.quick)
    fits = subject_fits.by_geometry(Face(model), captures.train, schedule)
    fitted = fits.expressions("train")
    face = Face(model, fits.face.S, linear=fastest(), tolerance=TOLERANCE)
    start = time.perf_counter()
    preview = make_preview(face, fitted, seed=SEED, seconds=np.inf, listen=lambda *_: None)
    seconds = time.perf_counter() - start
    told = preview.figures()
    sorts = told["error_by_sort_mm"]
    return {
        "vertices": len(model.rest),
        "tets": len(model.tets),
        "expressions": len(fitted),
        "controls": told["controls"],
        "modes": told["modes"],
        "poses": told["poses"],
        "seconds": seconds,
        **{f"{name}_mm": sorts["plausible"][name] for name in ("moved", "mean", "p95", "max")},
        "sorts": sorts,
        "presets": told["presets_mm"],
    }


def section(figures: Figures) -> Section:
    """Return the section of docs/science/benchmarks.md."""
    columns = {
        "poses": "poses",
        "moved": "skin moves, mm",
        "mean": "mean, mm",
        "p95": "95 % below, mm",
        "max": "greatest, mm",
    }
    rows = [[sort, *(each[key] for key in columns)] for sort, each in figures["sorts"].items()]
    presets = [[name, mean] for name, mean in figures["presets"].items()]
    return Section(
        title="Sliders",
        compared="The page's sliders move a reduced skin; it is compared with the simulated "
        f"equilibria of poses that it was not made from ({figures['vertices']:,} vertices, "
        f"{figures['tets']:,} tets). {figures['controls']} sliders and {figures['modes']} modes "
        f"were made from {figures['poses']['learned']} poses in {figures['seconds']:.0f} s.",
        parts=[
            Table(["unseen poses", *columns.values()], rows),
            Table(["fitted expression", "mean, mm"], presets),
        ],
    )


if __name__ == "__main__":
    main()
