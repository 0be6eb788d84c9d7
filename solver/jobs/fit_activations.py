"""The job that fits activations of new expressions."""

from __future__ import annotations

import time
from dataclasses import asdict, replace
from pathlib import Path

from solver.fitting import fallback
from solver.fitting.activation import UNSEEN, UNSEEN_STOP
from solver.fitting.target_checks import check_held, check_repeated, check_replaced
from solver.jobs import Task, fits
from solver.kinds.fit_activations import FitActivations
from solver.mechanics.linear import fastest
from solver.progress import Step, part_of
from solver.rig import Rig
from solver.rig.report import known_information


def run(task: Task[FitActivations]) -> list[Path]:
    """Fit activations and jaw of new expressions with the S of ``rig``; write the new rig's files.

    The rig's expressions are carried over; a new capture of the same name replaces the old. An
    expression that the reduced solver cannot fit is given to IPOPT; one that neither can fit stays
    at rest, unless all do.
    """
    given = task.options
    progress = task.progress
    progress(Step("read", 0.0, message=f"{len(task.captures)} scans"))
    parent = Rig.load(task.inputs)
    subject = parent.model
    carried = parent.expressions
    scans = fits.read_scans(subject, task.captures)
    drive = fits.asked_drive(given, parent.drive)
    parent = replace(parent, drive=drive)
    face = parent.face(given.linear_solver or fastest())
    check_held(face)
    knowledge = fits.read_known_scans(task, face, scans)
    targets = fits.Targets(subject, given.distance).of_scans(scans)
    log = fits.WarningLog(subject, progress)
    oddities = fits.find_oddities(face, scans, targets, drive)
    for fit in carried:
        if fit.name in scans:
            oddities += check_replaced(subject, fit.name, fit.target, scans[fit.name])
    others = {fit.name: fit.target for fit in carried if fit.name not in scans}
    for name, scan in scans.items():
        oddities += check_repeated(subject, name, scan, others)
    if given.solver == "ipopt":
        oddities += fallback.warn_of_slowness(face)
    log.warn(0.02, oddities)
    stop = replace(UNSEEN_STOP, max_iterations=given.max_iterations)
    begin = time.perf_counter()
    fitted = fits.fit_unseen(
        face, scans, targets, log, fits.JobPart(0.02, 0.5), knowledge, stop, given.solver
    )
    kept = [fit for fit in carried if fit.name not in scans]
    asked = given.model_dump(include={"distance", "solver"})
    settings = {**UNSEEN, **asdict(stop), **asked, **fits.control_settings(drive)}
    # the expressions that S was fitted to share its time
    trained = [fit for fit in carried if fit.role == "train"]
    together = [fit.seconds for fit in trained]
    seconds = {"geometry": sum(together)} if together else {}
    seconds["activations"] = time.perf_counter() - begin
    expressions = (*kept, *fitted)
    systems = fits.carried_systems(parent, scans)
    whole = Rig(subject, face.S, expressions, seconds, log.general, drive=drive, systems=systems)
    whole = replace(whole, rounds=parent.rounds)
    same = not any(fit.name in scans for fit in trained)
    information = known_information(parent) if same else None
    return fits.leave_rig(face, whole, settings, task.out, part_of(progress, 0.5), information)
