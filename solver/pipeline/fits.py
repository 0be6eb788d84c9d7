"""The jobs that fit: the muscle geometry of a subject, and activations of new expressions."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sp

from solver.errors import InputError
from solver.fitting import activation, geometry, standard
from solver.fitting.face import Face, State
from solver.fitting.geometry import GeometryOptions
from solver.fitting.objective import Target
from solver.model import SubjectModel
from solver.pipeline.common import Options, refuse, take
from solver.progress import Progress, Step, silent
from solver.rig.certificate import certify, with_round_trips
from solver.rig.export import write_rig
from solver.rig.result import ExpressionFit, Rig, load_activations, load_weights
from solver.scans.read import read_registered
from solver.scans.registered import RegisteredScan


def fit_geometry(
    model: Path,
    captures: Mapping[str, Path],
    out: Path,
    *,
    options: Options = None,
    progress: Progress = silent,
) -> list[Path]:
    """Fit S, activations and jaw to several registered expression scans; write the rig's files.

    Options: at most ``rounds`` of Gauss-Newton, ``linear_solver``.
    """
    given = take(options, {"rounds": GeometryOptions.rounds, "linear_solver": None})
    subject, scans = _read(model, captures, progress)
    face = Face(subject, linear=given["linear_solver"])
    targets = {name: _target(subject, scan) for name, scan in scans.items()}
    data = standard.terms(face, targets)
    schedule = GeometryOptions(rounds=given["rounds"])

    def listen(number: int, states: Mapping[str, State]) -> None:
        done = 0.02 + 0.78 * number / schedule.rounds
        error = geometry.mean_error(face, targets, states)
        progress(Step("geometry", done, number + 1, mean_error_mm=error))

    start = time.perf_counter()
    fitted = geometry.fit(face, data, schedule, listen=listen)
    seconds = time.perf_counter() - start
    expressions = tuple(
        _expression(
            face,
            name,
            "train",
            scans[name],
            targets[name],
            fitted.states[name],
            iterations=fitted.iterations[name],
            seconds=seconds / len(targets),
        )
        for name in targets
    )
    settings = asdict(schedule)
    return _export(
        face, fitted.S, expressions, {"geometry": seconds}, settings, out, _later(progress, 0.8)
    )


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
    new capture of the same name replaces the old. Options: ``max_iterations``, ``linear_solver``.
    """
    known = {"max_iterations": standard.UNSEEN_STOP.max_iterations, "linear_solver": None}
    given = take(options, known)
    subject, scans = _read(model, captures, progress)
    S = load_weights(weights, subject)
    carried = () if rig is None else load_activations(_activations_file(rig), subject)
    face = Face(subject, linear=given["linear_solver"])
    rest = face.rest_state(S)
    regulariser = standard.unseen_regulariser(face)
    stop = replace(standard.UNSEEN_STOP, max_iterations=given["max_iterations"])
    targets = {name: _target(subject, scan) for name, scan in scans.items()}
    data = standard.terms(face, targets)
    expressions = [fit for fit in carried if fit.name not in scans]
    begin = time.perf_counter()
    for number, (name, scan) in enumerate(scans.items()):

        def listen(iteration: int, value: float, number: int = number, name: str = name) -> None:
            part = (number + iteration / stop.max_iterations) / len(scans)
            progress(Step("activations", 0.02 + 0.48 * part, iteration, value, message=name))

        start = time.perf_counter()
        fitted = activation.fit(face, S, data[name], regulariser, rest, stop, listen)
        expressions.append(
            _expression(
                face,
                name,
                "test",
                scan,
                targets[name],
                fitted.state,
                iterations=fitted.iterations,
                seconds=time.perf_counter() - start,
            )
        )
    seconds = {"activations": time.perf_counter() - begin}
    settings = {**standard.UNSEEN, **asdict(stop)}
    return _export(face, S, tuple(expressions), seconds, settings, out, _later(progress, 0.5))


def _read(
    model: Path, captures: Mapping[str, Path], progress: Progress
) -> tuple[SubjectModel, dict[str, RegisteredScan]]:
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
    return subject, scans


def _target(model: SubjectModel, scan: RegisteredScan) -> Target:
    return Target.from_points(scan.vertices[model.face], scan.confidence[model.face])


def _expression(
    face: Face,
    name: str,
    role: str,
    scan: RegisteredScan,
    target: Target,
    state: State,
    *,
    iterations: int,
    seconds: float,
) -> ExpressionFit:
    points = face.face_points(state.x)
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
        iterations=iterations,
        seconds=seconds,
        objective=target.value(points),
        x=state.x,
    )


def _export(
    face: Face,
    S: sp.csr_array,
    expressions: tuple[ExpressionFit, ...],
    seconds: dict[str, float],
    settings: dict[str, Any],
    out: Path,
    progress: Progress,
) -> list[Path]:
    """Check what was fitted and write the rig's files; ``progress`` counts from 0 to 1 here."""

    def listen(name: str, number: int) -> None:
        progress(Step("round_trip", 0.85 * number / len(expressions), number + 1, message=name))

    start = time.perf_counter()
    expressions = with_round_trips(face, S, expressions, listen)
    seconds = {**seconds, "round_trip": time.perf_counter() - start}
    rig = Rig(face.model, S, expressions, seconds)
    progress(Step("export", 0.85, message="certificate, exports and pictures"))
    files = write_rig(rig, certify(face, rig, settings), out)
    progress(Step("done", 1.0))
    return files


def _later(progress: Progress, begin: float) -> Progress:
    """Return a progress whose way from 0 to 1 is the rest of the job from ``begin``."""
    return lambda step, /: progress(replace(step, fraction=begin + (1.0 - begin) * step.fraction))


def _activations_file(rig: Path) -> Path:
    return rig / "activations.npz" if rig.is_dir() else rig
