"""The jobs that fit: the muscle geometry of a subject, and activations of new expressions."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError, Notice, SolveError
from solver.fitting import (
    chosen,
    geometry,
    target_checks,
)
from solver.fitting.activation import Resting
from solver.fitting.chosen import ChosenFit, Solver
from solver.fitting.face import Face, State
from solver.fitting.geometry import GeometryFit, GeometryOptions
from solver.fitting.joint import mirror_structure, transferred
from solver.fitting.objective import Target
from solver.fitting.target_checks import (
    check_held,
    idle_muscles,
)
from solver.mechanics.flesh import IDENTITY
from solver.mechanics.linear import fastest
from solver.meshio.registered import RegisteredScan, read_registered
from solver.model import SubjectModel
from solver.pipeline.common import (
    Distance,
    Options,
    Targets,
    Telling,
    activations_file,
    check_choice,
    refuse,
    take,
)
from solver.progress import Progress, Step, silent
from solver.rig.certificate import certify, with_round_trips
from solver.rig.export import write_rig
from solver.rig.result import ExpressionFit, load_activations, load_weights
from solver.rig.rig import Rig


def fit_geometry(
    model: Path,
    captures: Mapping[str, Path],
    out: Path,
    *,
    start: tuple[Path, Path] | None = None,
    options: Options = None,
    progress: Progress = silent,
) -> list[Path]:
    """Fit S, activations and jaw to several registered expression scans; write the rig's files.

    ``start`` is a fitted ``muscle_weights.npz`` and the model it belongs to, this one's or another
    subject's, for S to begin with. Options: at most ``rounds`` of Gauss-Newton, ``symmetry`` (the
    weight of the mirror prior on S, 0 for none), ``distance`` (``point`` or ``plane``),
    ``solver`` (``reduced``, or ``ipopt`` on small meshes), ``linear_solver``.
    """
    known = {
        "rounds": GeometryOptions.rounds,
        "symmetry": 0.0,
        "distance": "point",
        "solver": "reduced",
        "linear_solver": None,
    }
    given = _take(options, known)
    face, scans = _read(model, captures, given["linear_solver"], progress)
    subject = face.model
    schedule = GeometryOptions(rounds=given["rounds"])
    if given["solver"] == "ipopt":
        geometry.check_size(face, len(scans))
    priors = {"start": _begun(subject, start), "structure": _mirrored(subject, given["symmetry"])}
    told = Telling(subject, progress)
    told.tell(0.02, [*_odd(face, scans), *_too_few(scans)])
    targets = _targets(subject, scans, given["distance"])
    begin = time.perf_counter()
    if given["solver"] == "ipopt":
        fitted = _geometry_by_ipopt(face, targets, schedule, priors, told, progress)
    else:
        fitted = _geometry(face, targets, schedule, priors, progress)
    seconds = time.perf_counter() - begin
    expressions = []
    for name, ending in fitted.endings.items():
        ending = replace(ending, iterations=fitted.iterations[name])
        expression = _expression(
            face, name, "train", scans[name], targets[name], ending, seconds / len(targets)
        )
        expressions.append(told.about(expression, 0.8, ending.notices))
    _refuse_failures(expressions)
    chosen_options = {name: given[name] for name in ("symmetry", "distance", "solver")}
    settings = {**asdict(schedule), **chosen_options}
    rig = Rig(subject, fitted.S, tuple(expressions), {"geometry": seconds}, told.general)
    return _export(face, rig, settings, out, _later(progress, 0.8))


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

    data, easy = chosen.terms(face, targets), chosen.distances(face, targets)
    return geometry.fit(face, data, schedule, easy=easy, listen=listen, **priors)


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

    data = chosen.terms(face, targets)
    fitted, notices = geometry.fit_by_ipopt(face, data, schedule, listen, **priors)
    told.tell(0.8, notices)
    return fitted


def fit_activations(
    model: Path,
    weights: Path,
    captures: Mapping[str, Path],
    out: Path,
    *,
    rig: Path | None = None,
    options: Options = None,
    progress: Progress = silent,
) -> list[Path]:
    """Fit activations and jaw of new expressions with the S of ``weights``; write the rig's files.

    ``rig`` (``activations.npz`` of a rig, or its folder) carries that rig's expressions over; a
    new capture of the same name replaces the old. Options: ``max_iterations``, ``distance``
    (``point`` or ``plane``), ``solver`` (``reduced`` or ``ipopt``), ``linear_solver``. An
    expression that the reduced solver can not fit is given to IPOPT; one that neither can fit
    stays at rest, unless all do.
    """
    known = {
        "max_iterations": chosen.UNSEEN_STOP.max_iterations,
        "distance": "point",
        "solver": "reduced",
        "linear_solver": None,
    }
    given = _take(options, known)
    face, scans = _read(model, captures, given["linear_solver"] or fastest(), progress)
    subject = face.model
    face = face.with_weights(load_weights(weights, subject))
    carried = () if rig is None else load_activations(activations_file(rig), subject)
    told = Telling(subject, progress)
    told.tell(0.02, _odd(face, scans))
    told.tell(0.02, _replaced(subject, carried, scans))
    if given["solver"] == "ipopt":
        told.tell(0.02, chosen.slowness(face))
    rest = Resting(face)
    regulariser = chosen.unseen_regulariser(face)
    stop = replace(chosen.UNSEEN_STOP, max_iterations=given["max_iterations"])
    targets = _targets(subject, scans, given["distance"])
    data = chosen.terms(face, targets)
    fitted = []
    begin = time.perf_counter()
    for number, (name, scan) in enumerate(scans.items()):

        def listen(iteration: int, value: float, number: int = number, name: str = name) -> None:
            part = (number + min(iteration / stop.max_iterations, 1.0)) / len(scans)
            progress(Step("activations", 0.02 + 0.48 * part, iteration, value, message=name))

        start = time.perf_counter()
        found = chosen.fit(face, data[name], regulariser, rest, stop, given["solver"], listen)
        spent = time.perf_counter() - start
        expression = _expression(face, name, "test", scan, targets[name], found, spent)
        done = 0.02 + 0.48 * (number + 1) / len(scans)
        fitted.append(told.about(expression, done, found.notices))
    _refuse_failures(fitted)
    kept = [fit for fit in carried if fit.name not in scans]
    chosen_options = {name: given[name] for name in ("distance", "solver")}
    settings = {**chosen.UNSEEN, **asdict(stop), **chosen_options}
    seconds = {**_geometry_seconds(carried), "activations": time.perf_counter() - begin}
    whole = Rig(subject, face.S, (*kept, *fitted), seconds, told.general)
    return _export(face, whole, settings, out, _later(progress, 0.5))


def _geometry_seconds(carried: Sequence[ExpressionFit]) -> dict[str, float]:
    """Return what the fit of S took: its expressions, solved together, share it."""
    together = [fit.seconds for fit in carried if fit.role == "train"]
    return {"geometry": sum(together)} if together else {}


def _begun(subject: SubjectModel, start: tuple[Path, Path] | None) -> sp.csr_array | None:
    """Return the S that a fit begins with, None for the model's own."""
    if start is None:
        return None
    weights, source = start[0], SubjectModel.load(start[1])
    return transferred(load_weights(weights, source), source, subject)


def _mirrored(subject: SubjectModel, symmetry: float) -> sp.csr_array | None:
    if not (isinstance(symmetry, int | float) and 0.0 <= symmetry < np.inf):
        raise InputError("options.symmetry", f"symmetry is a weight of 0 or more, not {symmetry!r}")
    return mirror_structure(subject, symmetry) if symmetry > 0.0 else None


def _take(options: Options, known: dict[str, Any]) -> dict[str, Any]:
    """Return the options with their defaults; raises ``options.solver``, ``options.distance``."""
    given = take(options, known)
    check_choice(given, "solver", get_args(Solver))
    check_choice(given, "distance", get_args(Distance))
    return given


def _read(
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


def _odd(face: Face, scans: Mapping[str, RegisteredScan]) -> list[Notice]:
    return [*idle_muscles(face), *target_checks.before_fit(face.model, scans)]


def _too_few(scans: Mapping[str, RegisteredScan]) -> list[Notice]:
    if len(scans) > 1:
        return []
    message = (
        "the muscle geometry is fitted to one expression: it will follow that one and say little "
        "of others; use three or more that differ"
    )
    return [Notice("fit.one_target", message)]


def _replaced(
    model: SubjectModel, carried: Sequence[ExpressionFit], scans: Mapping[str, RegisteredScan]
) -> list[Notice]:
    """Return which expressions of the parent rig are replaced by another face."""
    return [
        notice
        for fit in carried
        if fit.name in scans
        for notice in target_checks.replaced(model, fit.name, fit.target, scans[fit.name])
    ]


def _refuse_failures(fits: Sequence[ExpressionFit]) -> None:
    """Raise ``fit.failed`` if no expression could be fitted at all: there is nothing to keep."""
    rest = [fit.status == "failed" and (fit.activations == IDENTITY).all() for fit in fits]
    if all(rest):
        reasons = "; ".join(
            f"{fit.name}: {notice.message}" for fit in fits for notice in fit.notices
        )
        raise SolveError("fit.failed", f"no expression could be fitted ({reasons})")


def _targets(
    model: SubjectModel, scans: Mapping[str, RegisteredScan], distance: Distance
) -> dict[str, Target]:
    targets = Targets(model, distance)
    return {name: targets.of_scan(scan) for name, scan in scans.items()}


def _expression(
    face: Face,
    name: str,
    role: str,
    scan: RegisteredScan,
    target: Target,
    found: ChosenFit,
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


def _export(
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


def _later(progress: Progress, begin: float) -> Progress:
    """Return a progress whose way from 0 to 1 is the rest of the job from ``begin``."""
    return lambda step, /: progress(replace(step, fraction=begin + (1.0 - begin) * step.fraction))
