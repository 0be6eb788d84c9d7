"""The jobs, as functions.

Each reads files, writes its results into a folder and reports progress. A worker calls them in a
process of its own, the offline command line directly.
"""

from solver.pipeline.checks import check_scan
from solver.pipeline.edit import edit
from solver.pipeline.fits import fit_activations, fit_geometry
from solver.pipeline.models import build_model
from solver.pipeline.preview import build_preview
from solver.pipeline.registration import register_scan
from solver.pipeline.scenes import PersonFiles, animate, simulate
from solver.pipeline.sequence import fit_sequence

__all__ = [
    "PersonFiles",
    "animate",
    "build_model",
    "build_preview",
    "check_scan",
    "edit",
    "fit_activations",
    "fit_geometry",
    "fit_sequence",
    "register_scan",
    "simulate",
]
