"""The job that fits the muscle geometry of a subject."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import scipy.sparse as sp

from solver.errors import Finding, make_warning
from solver.fitting import geometry
from solver.fitting.contact import terms
from solver.fitting.face import Face, State
from solver.fitting.geometry import GeometryFit, GeometryOptions
from solver.fitting.objective import Target, distances
from solver.fitting.simplex import mirror_structure, transfer
from solver.jobs.common import Telling
from solver.jobs.fits import (
    describe_fit,
    export_rig,
    find_oddities,
    read_scans,
    refuse_failures,
    rest_of,
    targets_of,
)
from solver.jobs.task import Task
from solver.kinds.fit_geometry import FitGeometry
from solver.meshio.registered import RegisteredScan
from solver.model import SubjectModel
from solver.progress import Progress, Step
from solver.rig.result import load_weights
from solver.rig.rig import Rig


def run(task: Task[FitGeometry]) -> list[Path]:
    """Fit S, activations and jaw to several registered expression scans; write the rig's files.

    The inputs ``start_weights`` and ``start_model`` are a fitted ``muscle_weights.npz`` and the
    model it belongs to, this one's or another subject's, for S to begin with.
    """
    given, progress = task.options, task.progress
    face, scans = read_scans(task.inputs["model"], task.captures, given.linear_solver, progress)
    subject = face.model
    schedule = GeometryOptions(rounds=given.rounds)
    if given.solver == "ipopt":
        geometry.check_size(face, len(scans))
    priors = {"start": _start(subject, task), "structure": _mirror(subject, given.symmetry)}
    told = Telling(subject, progress)
    told.tell(0.02, [*find_oddities(face, scans), *_too_few(scans)])
    targets = targets_of(subject, scans, given.distance)
    begin = time.perf_counter()
    if given.solver == "ipopt":
        fitted = _geometry_by_ipopt(face, targets, schedule, priors, told, progress)
    else:
        fitted = _geometry(face, targets, schedule, priors, progress)
    seconds = time.perf_counter() - begin
    expressions = []
    for name, ending in fitted.endings.items():
        expression = describe_fit(
            face, name, "train", scans[name], targets[name], ending, seconds / len(targets)
        )
        expressions.append(told.about(expression, 0.8, ending.notices))
    refuse_failures(expressions)
    chosen_options = given.model_dump(include={"symmetry", "distance", "solver"})
    settings = {**asdict(schedule), **chosen_options}
    rig = Rig(subject, fitted.S, tuple(expressions), {"geometry": seconds}, told.general)
    return export_rig(face, rig, settings, task.out, rest_of(progress, 0.8))


def _geometry(
    face: Face,
    targets: Mapping[str, Target],
    schedule: GeometryOptions,
    priors: Mapping[str, Any],
    progress: Progress,
) -> GeometryFit:
    def listen(number: int, states: Mapping[str, State]) -> None:
        done = 0.02 + 0.78 * number / schedule.rounds
        error = geometry.mean_error(face, targets, states)
        progress(Step("geometry", done, number + 1, mean_error_mm=error))

    data, first_terms = terms(face, targets), distances(face, targets)
    return geometry.fit(face, data, schedule, first_terms=first_terms, listen=listen, **priors)


def _geometry_by_ipopt(
    face: Face,
    targets: Mapping[str, Target],
    schedule: GeometryOptions,
    priors: Mapping[str, Any],
    told: Telling,
    progress: Progress,
) -> GeometryFit:
    def listen(iteration: int, value: float) -> None:
        part = min(iteration / geometry.most_iterations(schedule), 1.0)
        progress(Step("geometry", 0.02 + 0.78 * part, iteration, value))

    data = terms(face, targets)
    fitted, notices = geometry.fit_by_ipopt(face, data, schedule, listen, **priors)
    told.tell(0.8, notices)
    return fitted


def _start(subject: SubjectModel, task: Task[FitGeometry]) -> sp.csr_array | None:
    """Return the S that a fit begins with, None for the model's own."""
    if "start_weights" not in task.inputs:
        return None
    source = SubjectModel.load(task.inputs["start_model"])
    return transfer(load_weights(task.inputs["start_weights"], source), source, subject)


def _mirror(subject: SubjectModel, symmetry: float) -> sp.csr_array | None:
    return mirror_structure(subject, symmetry) if symmetry > 0.0 else None


def _too_few(scans: Mapping[str, RegisteredScan]) -> list[Finding]:
    if len(scans) > 1:
        return []
    message = (
        "the muscle geometry is fitted to one expression: it will follow that one and say little "
        "of others; use three or more that differ"
    )
    return [make_warning("fit.one_target", message)]
