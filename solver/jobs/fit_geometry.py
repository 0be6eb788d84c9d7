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
from solver.fitting.face import Face, PosedFace
from solver.fitting.geometry import GeometryFit, GeometryOptions
from solver.fitting.joint import RoundEnd
from solver.fitting.objective import Target, distances
from solver.fitting.recruitment import recruit
from solver.fitting.simplex import mirror_structure, smooth_structure, transfer
from solver.fitting.target_checks import check_held
from solver.jobs import Task, fits
from solver.kinds.fit_geometry import FitGeometry
from solver.model import SubjectModel
from solver.progress import ProgressCallback, Step, part_of
from solver.rig import Rig
from solver.rig.report.measures import check_neutral
from solver.rig.rig import FitRound
from solver.scans.known_activations import NOTHING

# of rounds whose mean grows
CLOSING = "muscles are brought within what muscles can do: the mean may rise meanwhile"


def run(task: Task[FitGeometry]) -> list[Path]:
    """Fit S, activations and jaw to several registered expression scans; write the rig's files.

    The input ``start`` is a rig, of this subject or another, whose S the fit begins with.
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0, message=f"{len(task.captures)} scans"))
    subject = SubjectModel.load(task.inputs["model"])
    scans = fits.read_scans(subject, task.captures)
    drive = fits.asked_drive(given)
    bounded = drive.loosen(0.0)
    face = Face(subject, linear=given.linear_solver)
    if bounded is not None:
        face = face.with_jaw_on_tracks()
    check_held(face)
    schedule = geometry.usual_options(subject, bounded, given.rounds)
    if given.solver == "ipopt":
        geometry.check_size(face, len(scans))
    targets = fits.Targets(subject, given.distance).of_scans(scans)
    known = fits.read_known_scans(task, face, scans)
    priors: dict[str, Any] = {"recruited": recruit(face, targets), "known": known}
    if "start" in task.inputs:
        start = Rig.load(task.inputs["start"])
        priors["start"] = transfer(start.weights, start.model, subject)
    structures = []
    if given.symmetry > 0.0:
        structures.append(mirror_structure(subject, given.symmetry))
    if given.smoothness > 0.0:
        structures.append(smooth_structure(subject, given.smoothness))
    if structures:
        priors["structure"] = sp.csr_array(sp.vstack(structures))
    log = fits.WarningLog(subject, progress)
    oddities = fits.find_oddities(face, scans, targets, drive)
    if len(scans) == 1:
        message = (
            "the muscle geometry is fitted to one expression: it will follow that one and say "
            "little of others; use three or more that differ"
        )
        oddities.append(make_warning("fit.one_target", message))
    log.warn(0.02, oddities)
    begin = time.perf_counter()
    fitted, rounds, notices = _fit(given.solver, face, targets, schedule, priors, progress)
    log.warn(0.8, notices)
    seconds = time.perf_counter() - begin
    expressions = []
    for name, ending in fitted.endings.items():
        about = (fitted.face, name, "train", scans[name], targets[name])
        each = seconds / len(targets)
        expression = fits.describe_fit(*about, ending, each, known.get(name, NOTHING))
        expressions.append(log.about(expression, 0.8, ending.notices))
    fits.refuse_failures(expressions)
    log.warn(0.8, check_neutral(face.with_weights(fitted.S), expressions))
    asked = given.model_dump(include={"symmetry", "smoothness", "distance", "solver"})
    settings = asdict(schedule) | asked | fits.control_settings(drive)
    del settings["within"]
    if bounded is None:
        del settings["tightening"]
    spent = {"geometry": seconds}
    rig = Rig(subject, fitted.S, tuple(expressions), spent, log.general, drive=drive, rounds=rounds)
    return fits.leave_rig(fitted.face, rig, settings, task.out, part_of(progress, 0.8))


def _fit(
    solver: str,
    face: Face,
    targets: Mapping[str, Target],
    schedule: GeometryOptions,
    priors: Mapping[str, Any],
    progress: ProgressCallback,
) -> tuple[GeometryFit, tuple[FitRound, ...], tuple[Finding, ...]]:
    """Fit by a solver; returns its rounds, and what IPOPT noticed, which has none."""
    rounds: list[FitRound] = []

    def listen_ipopt(iteration: int, value: float) -> None:
        part = min(iteration / geometry.most_iterations(schedule), 1.0)
        progress(Step("geometry", 0.02 + 0.78 * part, iteration, value))

    def listen(number: int, states: Mapping[str, PosedFace]) -> None:
        done = 0.02 + 0.78 * number / schedule.most_rounds
        error = geometry.mean_error(face, targets, states)
        closing = schedule.within is not None and number >= schedule.rounds
        message = CLOSING if closing else None
        progress(Step("geometry", done, number + 1, mean_error_mm=error, message=message))

    def ended(end: RoundEnd) -> None:
        error = geometry.mean_error(face, targets, end.states)
        loosened = schedule.loosened_in(end.number)
        rounds.append(FitRound(end.number + 1, loosened, end.objective, error, end.seconds))

    data = terms(face, targets)
    if solver == "ipopt":
        found, notices = geometry.fit_by_ipopt(face, data, schedule, listen_ipopt, **priors)
        return found, (), notices
    first_terms = distances(face, targets)
    found = geometry.fit(
        face, data, schedule, first_terms=first_terms, listen=listen, ended=ended, **priors
    )
    return found, tuple(rounds), ()
