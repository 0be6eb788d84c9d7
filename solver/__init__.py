"""Anatomy, scans, mechanics, fitting and the rig: numbers only, and the library's front door.

from solver import Face, Rig, SubjectModel

The names of ``__all__`` are imported when they are first asked for: ``import solver`` is fast, and
each room still imports no more than it needs.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from solver.anatomy.template import Template as Template
    from solver.fitting.activation import ActivationOptions as ActivationOptions
    from solver.fitting.activation import unseen_regulariser as unseen_regulariser
    from solver.fitting.contact import terms as expression_terms  # noqa: F401
    from solver.fitting.contraction import Contraction as Contraction
    from solver.fitting.drives.admissible import Admissible as Admissible
    from solver.fitting.drives.admissible import AdmissibleLimits as AdmissibleLimits
    from solver.fitting.expression_basis import ExpressionBasis as ExpressionBasis
    from solver.fitting.face import Face as Face
    from solver.fitting.face import Pose as Pose
    from solver.fitting.fallback import fit as fit_expression  # noqa: F401
    from solver.fitting.geometry import GeometryOptions as GeometryOptions
    from solver.fitting.geometry import fit as fit_geometry  # noqa: F401
    from solver.fitting.objective import Target as Target
    from solver.fitting.sensitivity import Sensitivity as Sensitivity
    from solver.fitting.tracking import Tracker as Tracker
    from solver.fitting.tracking.dense import DensePoints as DensePoints
    from solver.fitting.tracking.dense import SeenPoints as SeenPoints
    from solver.jobs import run_job as run_job
    from solver.mechanics.flesh import Material as Material
    from solver.mechanics.terms import PassiveTerm as PassiveTerm
    from solver.mechanics.terms import check_term as check_term
    from solver.meshio.registered import RegisteredScan as RegisteredScan
    from solver.meshio.registered import read_registered as read_registered
    from solver.meshio.registered import write_registered as write_registered
    from solver.model import SubjectModel as SubjectModel
    from solver.rig import Rig as Rig
    from solver.rig.exporters import export as export
    from solver.simulation import Simulator as Simulator
    from solver.tracks.autodiff import jax_function as jax_function
    from solver.tracks.autodiff import torch_function as torch_function
    from solver.tracks.basis import MuscleTracks as MuscleTracks
    from solver.tracks.face import TrackFace as TrackFace
    from solver.tracks.fit import fit as fit_tracks  # noqa: F401
    from solver.tracks.response import TrackResponse as TrackResponse

# Read when the first kernel starts its threads. Else these wait busily for the next kernel, which
# takes a tenth of the speed from what runs meanwhile and half of the processor from other workers.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

_PLACES = {
    "ActivationOptions": "solver.fitting.activation:ActivationOptions",
    "Admissible": "solver.fitting.drives.admissible:Admissible",
    "AdmissibleLimits": "solver.fitting.drives.admissible:AdmissibleLimits",
    "Contraction": "solver.fitting.contraction:Contraction",
    "DensePoints": "solver.fitting.tracking.dense:DensePoints",
    "ExpressionBasis": "solver.fitting.expression_basis:ExpressionBasis",
    "Face": "solver.fitting.face:Face",
    "GeometryOptions": "solver.fitting.geometry:GeometryOptions",
    "Material": "solver.mechanics.flesh:Material",
    "MuscleTracks": "solver.tracks.basis:MuscleTracks",
    "PassiveTerm": "solver.mechanics.terms:PassiveTerm",
    "Pose": "solver.fitting.face:Pose",
    "RegisteredScan": "solver.meshio.registered:RegisteredScan",
    "Rig": "solver.rig:Rig",
    "SeenPoints": "solver.fitting.tracking.dense:SeenPoints",
    "Sensitivity": "solver.fitting.sensitivity:Sensitivity",
    "Simulator": "solver.simulation:Simulator",
    "SubjectModel": "solver.model:SubjectModel",
    "Target": "solver.fitting.objective:Target",
    "Template": "solver.anatomy.template:Template",
    "TrackFace": "solver.tracks.face:TrackFace",
    "TrackResponse": "solver.tracks.response:TrackResponse",
    "Tracker": "solver.fitting.tracking:Tracker",
    "check_term": "solver.mechanics.terms:check_term",
    "export": "solver.rig.exporters:export",
    "expression_terms": "solver.fitting.contact:terms",
    "fit_expression": "solver.fitting.fallback:fit",
    "fit_geometry": "solver.fitting.geometry:fit",
    "fit_tracks": "solver.tracks.fit:fit",
    "jax_function": "solver.tracks.autodiff:jax_function",
    "read_registered": "solver.meshio.registered:read_registered",
    "run_job": "solver.jobs:run_job",
    "torch_function": "solver.tracks.autodiff:torch_function",
    "unseen_regulariser": "solver.fitting.activation:unseen_regulariser",
    "write_registered": "solver.meshio.registered:write_registered",
}


__all__ = list(_PLACES)


def __getattr__(name: str) -> Any:
    """Import one of the names of ``__all__``."""
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _PLACES[name].partition(":")
    return globals().setdefault(name, getattr(import_module(module), attribute))


def __dir__() -> list[str]:
    """Name what can be imported."""
    return sorted({*globals(), *__all__})
