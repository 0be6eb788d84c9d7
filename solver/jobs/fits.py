"""Shared by the fits of expressions: reading scans, describing fits, writing the rig."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from solver.errors import Finding, InputError, SolveError
from solver.fitting import target_checks
from solver.fitting.face import Face
from solver.fitting.fallback import FallbackFit
from solver.fitting.objective import Target
from solver.fitting.target_checks import check_held, idle_muscles
from solver.jobs.common import Targets, refuse
from solver.kinds.options import Distance
from solver.mechanics.flesh import IDENTITY
from solver.meshio.registered import RegisteredScan, read_registered
from solver.model import SubjectModel
from solver.progress import Progress, Step
from solver.rig.certificate import certify, with_round_trips
from solver.rig.exporters import write_rig
from solver.rig.result import ExpressionFit
from solver.rig.rig import Rig


def read_scans(
    model: Path, captures: Mapping[str, Path], linear: str | None, progress: Progress
) -> tuple[Face, dict[str, RegisteredScan]]:
    """Read the model and the registered scans; all are checked before any work begins."""
    if not captures:
        raise InputError("fit.no_captures", "a fit needs at least one expression scan")
    progress(Step("read", 0.0, message=f"{len(captures)} scans"))
    subject = SubjectModel.load(model)
    skin = subject.skin
    scans: dict[str, RegisteredScan] = {}
    faults: list[InputError] = []
    for name, path in captures.items():
        try:
            scan = read_registered(path, skin.faces, len(skin.vertices), neutral=skin.vertices)
            if not scan.confidence[subject.face].any():
                raise InputError(
                    "scan.confidence", f"{path.name} has no confidence on the face", file=path.name
                )
            scans[name] = scan
        except InputError as fault:
            faults.append(fault)
    refuse(faults)
    face = Face(subject, linear=linear)
    check_held(face)
    return face, scans


def find_oddities(face: Face, scans: Mapping[str, RegisteredScan]) -> list[Finding]:
    """Return what is odd about a face and scans before they are fitted."""
    return [*idle_muscles(face), *target_checks.before_fit(face.model, scans)]


def refuse_failures(fits: Sequence[ExpressionFit]) -> None:
    """Raise ``fit.failed`` if no expression could be fitted at all: there is nothing to keep."""
    rest = [fit.status == "failed" and (fit.activations == IDENTITY).all() for fit in fits]
    if all(rest):
        reasons = "; ".join(
            f"{fit.name}: {notice.message}" for fit in fits for notice in fit.notices
        )
        raise SolveError("fit.failed", f"no expression could be fitted ({reasons})")


def targets_of(
    model: SubjectModel, scans: Mapping[str, RegisteredScan], distance: Distance
) -> dict[str, Target]:
    """Return the scans as targets."""
    targets = Targets(model, distance)
    return {name: targets.of_scan(scan) for name, scan in scans.items()}


def describe_fit(
    face: Face,
    name: str,
    role: str,
    scan: RegisteredScan,
    target: Target,
    found: FallbackFit,
    seconds: float,
) -> ExpressionFit:
    """Return a fit with its distances; raises ``solve.not_finite`` rather than write NaN."""
    state = found.state
    points = face.face_points(state.x)
    if not (np.isfinite(state.x).all() and np.isfinite(state.pose.a).all()):
        raise SolveError("solve.not_finite", f"the fit of {name} is not finite")
    error = np.full(len(scan.vertices), np.nan)
    error[face.model.face] = target.distances(points)
    return ExpressionFit(
        name=name,
        role=role,
        activations=state.pose.a,
        jaw=state.pose.b,
        skin=face.whole_skin(state.x, state.pose.b),
        target=scan.vertices,
        error_mm=error,
        inverted=face.flesh.inverted(state.x),
        iterations=found.iterations,
        seconds=seconds,
        objective=target.value(points),
        x=state.x,
        solver=found.solver,
        status=found.status,
    )


def export_rig(
    face: Face, rig: Rig, settings: dict[str, Any], out: Path, progress: Progress
) -> list[Path]:
    """Check what was fitted and write the rig's files; ``progress`` counts from 0 to 1 here."""
    fits = rig.expressions

    def listen(name: str, number: int) -> None:
        progress(Step("round_trip", 0.85 * number / len(fits), number + 1, message=name))

    start = time.perf_counter()
    face = face.with_weights(rig.weights)
    fits = with_round_trips(face, fits, listen)
    seconds = {**rig.seconds, "round_trip": time.perf_counter() - start}
    rig = replace(rig, expressions=fits, seconds=seconds)
    progress(Step("export", 0.85, message="certificate, exports and pictures"))
    files = write_rig(rig, certify(face, rig, settings), out)
    progress(Step("done", 1.0))
    return files


def rest_of(progress: Progress, begin: float) -> Progress:
    """Return a progress whose way from 0 to 1 is the rest of the job from ``begin``."""
    return lambda step, /: progress(replace(step, fraction=begin + (1.0 - begin) * step.fraction))
